//! The pure parts, by random sequences of what may happen.

use super::super::book::{Book, Move};
use super::super::ledger::{FrameRecord, Ledger, Progress, Saved, ShotRecord, Stage};
use super::house::{Land, plan};
use super::*;
use crate::sink::manifest::FrameEntry;
use proptest::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

const ACTIVE: usize = 2;
const FRAMES: u32 = 5;

/// What happens to a queue.
#[derive(Debug, Clone)]
enum Step {
    Submit(i32),
    Order(u64, u8, i32),
    /// A frame of a shot in the farm comes: which shot, which frame of those that lack.
    Frame(usize, usize, bool),
    /// What has come is recorded.
    Record,
    /// Everything that is not on the disk is gone.
    Crash,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        2 => (-2..3).prop_map(Step::Submit),
        3 => (1..8u64, 0..4u8, -2..3).prop_map(|(id, what, n)| Step::Order(id, what, n)),
        8 => (0..9usize, 0..9usize, any::<bool>()).prop_map(|(a, b, c)| Step::Frame(a, b, c)),
        4 => Just(Step::Record),
        1 => Just(Step::Crash),
    ]
}

fn entry(index: FrameIndex) -> FrameEntry {
    FrameEntry {
        index,
        sha256: "0".repeat(64),
        ms: 1.5,
        render_ms: 2.5,
        jobs: 1,
        fallbacks: 0,
        fallback_share: 0.0,
        below_ground: false,
        error_px_p99: None,
        error_px_max: None,
        depth_error_m_p99: None,
        mismatch: None,
        checked_pixels: None,
    }
}

/// Book, ledger, and a farm that does what it is told.
struct Model {
    path: PathBuf,
    land: Land,
    ledger: Ledger,
    book: Book,
    last: u64,
    /// Shots in the farm, with the frames it has yet to send.
    farm: BTreeMap<ShotId, Vec<FrameIndex>>,
    in_hand: Vec<(ShotId, FrameIndex, FrameRecord)>,
    /// What was acknowledged as finished.
    recorded: BTreeSet<(ShotId, FrameIndex)>,
    acknowledged: BTreeMap<ShotId, (Stage, i32)>,
}

impl Model {
    fn new(folder: &Path) -> Self {
        let path = folder.join("queue.redb");
        let ledger = Ledger::open(&path).unwrap();
        Model {
            land: Land::new(folder),
            path,
            ledger,
            book: Book::new(Vec::new(), ACTIVE),
            last: 0,
            farm: BTreeMap::new(),
            in_hand: Vec::new(),
            recorded: BTreeSet::new(),
            acknowledged: BTreeMap::new(),
        }
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Submit(priority) => {
                let mut plan = plan(&self.land, FRAMES);
                plan.priority = priority;
                let cameras = std::mem::take(&mut plan.cameras);
                let (frames, stage) = (FRAMES, Stage::Open);
                let (note, workers, history) = (String::new(), Vec::new(), Vec::new());
                let record =
                    ShotRecord { plan, frames, submitted_s: 7, stage, note, workers, history };
                self.last += 1;
                let id = ShotId(self.last);
                self.ledger.add(id, &record, &cameras, None).unwrap();
                self.book.add(Saved { id, record, progress: Progress::default() });
                self.acknowledged.insert(id, (Stage::Open, priority));
            }
            Step::Order(id, what, priority) => self.order(ShotId(id), what, priority),
            Step::Frame(shot, frame, is_done) => {
                let Some((&id, frames)) = self.farm.iter_mut().nth(shot) else { return };
                if frames.is_empty() {
                    return;
                }
                let index = frames.remove(frame % frames.len());
                assert!(!self.recorded.contains(&(id, index)), "{id} {index} rendered twice");
                let record = match is_done {
                    true => FrameRecord::Done { entry: entry(index), bytes: 9 },
                    false => FrameRecord::Failed("no".into()),
                };
                self.book.count_in_hand(id, 1);
                self.in_hand.push((id, index, record));
            }
            Step::Record => self.record(),
            Step::Crash => self.crash(),
        }
        self.settle();
    }

    fn order(&mut self, id: ShotId, what: u8, priority: i32) {
        let order = match what {
            0 => Order::Pause(id),
            1 => Order::Resume(id),
            2 => Order::Cancel(id),
            _ => Order::Prioritise(id, priority),
        };
        let Ok(Some(record)) = self.book.ordered(order) else { return };
        self.ledger.put(id, &record).unwrap();
        self.acknowledged.insert(id, (record.stage, record.plan.priority));
        self.book.set(id, record);
        if what == 2 {
            self.leave(id);
        }
    }

    fn record(&mut self) {
        let frames = std::mem::take(&mut self.in_hand);
        for (shot, progress) in self.ledger.record(&frames).unwrap() {
            self.book.advance(shot, progress);
        }
        for (shot, index, _) in frames {
            self.book.count_in_hand(shot, -1);
            assert!(self.recorded.insert((shot, index)), "{shot} {index} finished twice");
            let state = self.book.get(shot).unwrap();
            if state.is_complete() && matches!(state.record.stage, Stage::Open | Stage::Paused) {
                let mut record = state.record.clone();
                record.stage = Stage::Done;
                self.ledger.put(shot, &record).unwrap();
                self.acknowledged.insert(shot, (Stage::Done, record.plan.priority));
                self.book.set(shot, record);
                self.leave(shot);
            }
        }
    }

    fn crash(&mut self) {
        let elsewhere = self.path.with_extension("moved");
        self.ledger = Ledger::open(&elsewhere).unwrap();
        self.ledger = Ledger::open(&self.path).unwrap();
        let (last, saved) = self.ledger.load().unwrap();
        assert_eq!(last, self.last);
        let found =
            saved.iter().map(|shot| (shot.id, (shot.record.stage, shot.record.plan.priority)));
        assert_eq!(found.collect::<BTreeMap<_, _>>(), self.acknowledged);
        for shot in &saved {
            let of_it = self.recorded.iter().filter(|(id, _)| *id == shot.id).count();
            assert_eq!(shot.progress.over() as usize, of_it, "{}", shot.id);
        }
        self.book = Book::new(saved, ACTIVE);
        self.farm.clear();
        self.in_hand.clear();
    }

    fn settle(&mut self) {
        for step in self.book.moves() {
            match step {
                Move::Enter(id) => {
                    let record = self.book.get(id).unwrap().record.clone();
                    let missing = self.ledger.missing(id, &record).unwrap();
                    assert!(
                        missing
                            .iter()
                            .all(|(index, camera)| { camera.position.x == f64::from(*index) })
                    );
                    self.farm.insert(id, missing.into_iter().map(|(index, _)| index).collect());
                    self.book.set_present(id, true);
                }
                Move::Leave(id) => self.leave(id),
            }
        }
        assert_eq!(self.book.moves(), [], "one round settles it");
        assert!(self.farm.len() <= 3 * ACTIVE);
        self.check_line();
    }

    /// The most urgent shots that can go on are in the farm.
    fn check_line(&self) {
        let mut open: Vec<_> = self
            .book
            .iter()
            .filter(|(id, shot)| {
                let may_enter = shot.in_hand == 0 && !shot.is_complete();
                shot.record.stage == Stage::Open && (may_enter || self.farm.contains_key(id))
            })
            .map(|(id, shot)| (std::cmp::Reverse(shot.record.plan.priority), id))
            .collect();
        open.sort();
        for (_, id) in open.into_iter().take(ACTIVE) {
            assert!(self.farm.contains_key(&id), "{id} waits without need");
        }
    }

    fn leave(&mut self, id: ShotId) {
        self.farm.remove(&id);
        self.book.set_present(id, false);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn no_finished_frame_is_rendered_twice_or_lost(
        steps in proptest::collection::vec(step(), 1..60)
    ) {
        let folder = tempfile::tempdir().unwrap();
        let mut model = Model::new(folder.path());
        for step in steps {
            model.take(step);
        }
        model.take(Step::Record);
        model.take(Step::Crash);
    }

    #[test]
    fn plans_come_back_from_json_bit_for_bit(numbers in proptest::array::uniform3(any::<f64>())) {
        let folder = tempfile::tempdir().unwrap();
        let mut before = plan(&Land::new(folder.path()), 1);
        let finite = numbers.map(|number| if number.is_finite() { number } else { 0.1 });
        before.cameras[0].position = finite.into();
        let text = serde_json::to_string(&before).unwrap();
        let after: ShotPlan = serde_json::from_str(&text).unwrap();
        prop_assert_eq!(
            after.cameras[0].position.to_array().map(f64::to_bits),
            finite.map(f64::to_bits)
        );
        prop_assert_eq!(after, before);
    }
}

/// Changes or cuts a ledger at a share of its length, and reads all that it then says.
fn damage(at: f64, flip: u8, cut: bool) {
    let folder = tempfile::tempdir().unwrap();
    let mut model = Model::new(folder.path());
    for _ in 0..5 {
        model.take(Step::Submit(0));
        model.take(Step::Frame(0, 0, true));
        model.take(Step::Record);
    }
    let path = model.path.clone();
    drop(model);
    let mut bytes = fs::read(&path).unwrap();
    let at = (at * bytes.len() as f64) as usize;
    bytes[at] ^= flip;
    if cut {
        bytes.truncate(at);
    }
    fs::write(&path, bytes).unwrap();
    if let Ok(mut ledger) = Ledger::open(&path) {
        let _ = ledger.load().map(|(_, saved)| {
            for shot in saved {
                let _ = ledger.missing(shot.id, &shot.record);
                let _ = ledger.frames(shot.id);
            }
        });
    }
}

#[test]
fn a_ledger_whose_allocator_state_is_damaged_ends_nothing() {
    damage(0.203_365_611_916_312_92, 1, false);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn a_damaged_ledger_is_an_error_and_ends_nothing(
        at in 0.0..1.0f64, flip in 1..=255u8, cut in any::<bool>()
    ) {
        damage(at, flip, cut);
    }
}

#[test]
fn shots_that_no_farm_renders_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let refused = |change: &dyn Fn(&mut ShotPlan), why: &str| {
        let mut plan = plan(&land, 2);
        plan.check().unwrap();
        change(&mut plan);
        let said = plan.check().unwrap_err().to_string();
        assert!(said.contains(why), "{said}");
    };
    refused(&|plan| plan.cameras.clear(), "1 to 1048576 cameras");
    refused(&|plan| plan.size = [0, 1], "each side has 1 to 16384");
    refused(&|plan| plan.size = [33, 16], "not all of its cameras");
    refused(&|plan| plan.fps = f64::NAN, "fps");
    refused(&|plan| plan.frames_in_flight = 0, "in flight");
    refused(&|plan| plan.cameras[1].tan_half_hfov = 1e9, "camera");
    refused(&|plan| plan.quality.tolerance_px = -1.0, "tolerance");
    refused(&|plan| plan.name = "x".repeat(300), "name");
    refused(&|plan| plan.source.scene = "x".repeat(5000), "source");
    refused(&|plan| plan.first_frame = u32::MAX, "first frame");
    let huge = |plan: &mut ShotPlan| {
        plan.size = [16_384, 16_384];
        plan.frames_in_flight = 9;
    };
    refused(&huge, "choose 4 or fewer");
}

#[test]
fn what_a_damaged_record_says_of_a_shot_is_counted_without_overflow() {
    let dir = tempfile::tempdir().unwrap();
    let land = Land::new(dir.path());
    let saved = (1..4).map(|number| {
        let mut plan = plan(&land, 1);
        (plan.size, plan.frames_in_flight) = ([u32::MAX; 2], u32::MAX);
        let (frames, stage) = (u32::MAX, Stage::Open);
        let (note, workers, history) = (String::new(), Vec::new(), Vec::new());
        let record = ShotRecord { plan, frames, submitted_s: 7, stage, note, workers, history };
        let progress = Progress { done: u32::MAX - 1, failed: 0, last: None };
        Saved { id: ShotId(number), record, progress }
    });
    let mut book = Book::new(saved.collect(), ACTIVE);
    assert_eq!(book.moves(), [Move::Enter(ShotId(1))]);
    book.set_present(ShotId(1), true);
    book.advance(ShotId(1), Progress { done: u32::MAX, failed: u32::MAX, last: None });
    assert!(book.get(ShotId(1)).unwrap().is_complete());
    assert!(!book.moves().contains(&Move::Enter(ShotId(1))));
}
