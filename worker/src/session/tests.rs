//! The session against a scripted and a random world.

#![allow(clippy::unwrap_used)]

use super::*;
use glam::DVec3;
use proptest::prelude::*;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::Shading;
use terrafarm_wire::message::{
    Ahead, CloseShot, Drain, RenderReport, Revoke, Timesheet, WantBlobs,
};
use terrafarm_wire::pixels::Pixels;

const INDEX: BlobHash = BlobHash([1; 32]);
/// The shot for which somebody waits.
const LIVE: u64 = 3;

fn tile(number: u8) -> BlobHash {
    BlobHash([100 + number; 32])
}

fn open(shot: u64) -> Event {
    let shading = Shading::default();
    let (quality, check) = (Quality::default(), Share::NONE);
    let (shot, live) = (ShotId(shot), shot == LIVE);
    Event::Received(
        OpenShot { shot, index: INDEX, shading, quality, check, width: 8, height: 4, live }.into(),
    )
}

fn grant(lease: u64, shot: u64) -> Event {
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, (8, 4));
    let region = Region::whole(8, 4);
    let (lease, shot) = (LeaseId(lease), ShotId(shot));
    Event::Received(Grant { lease, shot, frame: 0, region, camera }.into())
}

fn ahead(shot: u64, first: u32, cameras: usize) -> Event {
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, (8, 4));
    let cameras = vec![camera; cameras];
    Event::Received(Ahead { shot: ShotId(shot), first, stride: 10, cameras }.into())
}

fn elsewhere(hash: BlobHash) -> Event {
    Event::Received(Elsewhere { hash, workers: vec!["10.0.0.7:1".parse().unwrap()] }.into())
}

fn revoke(lease: u64) -> Event {
    Event::Received(Revoke { lease: LeaseId(lease) }.into())
}

fn blob(hash: BlobHash) -> Blob {
    Blob { hash, bytes: Default::default() }
}

fn done(lease: u64) -> Done {
    let pixels = Pixels::raw(vec![0; 96].into()).unwrap();
    let (report, timesheet) = (RenderReport::default(), Timesheet::default());
    Done { lease: LeaseId(lease), report, timesheet, check: None, pixels }
}

/// What the session wants after these events, in short.
fn after(session: &mut Session, events: impl IntoIterator<Item = Event>) -> Vec<String> {
    events.into_iter().for_each(|event| session.handle(event));
    std::iter::from_fn(|| session.poll_action()).map(|action| short(&action)).collect()
}

fn short(action: &Action) -> String {
    match action {
        Action::Send(Message::WantBlobs(want)) => format!("want {}", want.hashes.len()),
        Action::Send(Message::Done(done)) => format!("done {}", done.lease),
        Action::Send(Message::Failed(failed)) => {
            format!("failed {}: {}", failed.lease, failed.reason)
        }
        Action::Send(Message::HandBack(back)) => format!("hand back {}", back.leases.len()),
        Action::Send(Message::Goodbye(_)) => "goodbye".to_owned(),
        Action::Send(other) => format!("send {other:?}"),
        Action::Settle(lease) => format!("settle {lease}"),
        Action::Load(hash) => format!("load {hash}"),
        Action::Take(blob) => format!("take {}", blob.hash),
        Action::Start(grant, _) => format!("start {}", grant.lease),
        Action::Resume(lease) => format!("resume {lease}"),
        Action::Stop(lease) => format!("stop {lease}"),
        Action::Discard(lease) => format!("discard {lease}"),
        Action::Seek(hash) => format!("seek {hash}"),
        Action::Stock(blob) => format!("stock {}", blob.hash),
        Action::Fetch(elsewhere) => format!("fetch {}", elsewhere.hash),
        Action::Glance(glance, _) => format!("glance {} {}", glance.shot, glance.due),
        Action::Close(shot) => format!("close {shot}"),
        Action::Release(_) => "release".to_owned(),
        Action::End => "end".to_owned(),
    }
}

/// A session in which `lease-1` renders and `lease-2` waits.
fn rendering() -> Session {
    let mut session = Session::new();
    let wants = after(&mut session, [open(1), grant(1, 1), grant(2, 1)]);
    assert_eq!(wants, [format!("load {INDEX}")]);
    let wants = after(&mut session, [Event::Loaded(INDEX)]);
    assert_eq!(wants, ["start lease-1", "glance shot-1 0"]);
    assert!(after(&mut session, [Event::Glanced(Vec::new())]).is_empty());
    session
}

#[test]
fn a_job_waits_for_the_index_then_renders_then_is_sent_and_the_next_begins() {
    let mut session = rendering();
    assert_eq!(after(&mut session, [Event::Rendered(done(1))]), ["done lease-1"]);
    assert_eq!(after(&mut session, [Event::Sent]), [format!("load {INDEX}")]);
    assert_eq!(after(&mut session, [Event::Loaded(INDEX)]), ["start lease-2"]);
}

#[test]
fn missing_tiles_are_looked_for_here_then_asked_for_once() {
    let mut session = rendering();
    let wants = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1), tile(2)])]);
    assert_eq!(wants, [format!("load {}", tile(1)), format!("load {}", tile(2))]);
    assert!(after(&mut session, [Event::Loaded(tile(1))]).is_empty());
    assert_eq!(after(&mut session, [Event::Absent(tile(2))]), ["want 1"]);
    assert!(after(&mut session, [Event::Absent(tile(2))]).is_empty(), "asked once");
    let taken = after(&mut session, [Event::Received(blob(tile(2)).into())]);
    assert_eq!(taken, [format!("take {}", tile(2))]);
    assert_eq!(after(&mut session, [Event::Loaded(tile(2))]), ["resume lease-1"]);
}

#[test]
fn a_blob_that_cannot_be_had_fails_the_job_with_the_reason() {
    let mut session = rendering();
    after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1)]), Event::Absent(tile(1))]);
    let no = NoBlob { hash: tile(1), why: "the client has left".to_owned() };
    let said = after(&mut session, [Event::Received(no.into())]);
    assert_eq!(said[0], "discard lease-1");
    assert!(said[1].starts_with("failed lease-1: ") && said[1].ends_with("the client has left"));
    assert_eq!(said[2], format!("load {INDEX}"), "the next one begins");
}

#[test]
fn blobs_that_nobody_asked_for_are_dropped() {
    let mut session = rendering();
    assert!(after(&mut session, [Event::Received(blob(tile(9)).into())]).is_empty());
    let no = NoBlob { hash: tile(9), why: String::new() };
    assert!(after(&mut session, [Event::Received(no.into())]).is_empty());
}

#[test]
fn a_revoked_job_is_stopped_and_its_late_result_is_not_sent() {
    let mut session = rendering();
    assert_eq!(after(&mut session, [revoke(1)]), ["stop lease-1"]);
    let next = after(&mut session, [Event::Rendered(done(1))]);
    assert_eq!(next, [format!("load {INDEX}")], "no result, the next one");
    assert!(after(&mut session, [revoke(1), Event::Rendered(done(1))]).is_empty());
}

#[test]
fn a_revoked_lease_in_the_queue_is_forgotten_without_an_answer() {
    let mut session = rendering();
    assert!(after(&mut session, [revoke(2)]).is_empty());
    assert_eq!(after(&mut session, [Event::Rendered(done(1)), Event::Sent]), ["done lease-1"]);
}

#[test]
fn leaving_hands_back_what_waits_finishes_what_runs_and_says_goodbye() {
    let mut session = rendering();
    let leave = || Event::Received(Drain {}.into());
    assert_eq!(after(&mut session, [leave(), leave()]), ["hand back 1"]);
    assert_eq!(after(&mut session, [grant(3, 1)]), ["hand back 1"]);
    assert_eq!(after(&mut session, [Event::Rendered(done(1))]), ["done lease-1"]);
    assert_eq!(after(&mut session, [Event::Sent]), ["goodbye", "end"]);
    assert!(after(&mut session, [grant(4, 1), Event::Sent]).is_empty());
}

#[test]
fn an_idle_worker_leaves_at_once() {
    let mut session = Session::new();
    assert_eq!(after(&mut session, [Event::Leave("told".into())]), ["goodbye", "end"]);
}

#[test]
fn grants_that_make_no_sense_fail_with_a_reason() {
    let mut session = Session::new();
    let said = after(&mut session, [grant(1, 7)]);
    assert_eq!(said, ["failed lease-1: shot-7 has not been opened here"]);
    let Event::Received(Message::Grant(mut other)) = grant(2, 1) else { unreachable!() };
    other.camera.width = 16;
    let said = after(&mut session, [open(1), Event::Received(other.into())]);
    assert!(said[0].starts_with("failed lease-2: the camera has 16 x 4 pixels"), "{said:?}");
}

#[test]
fn the_same_lease_twice_is_one_job() {
    let mut session = rendering();
    assert!(after(&mut session, [grant(1, 1), grant(2, 1)]).is_empty());
}

#[test]
fn a_closed_shot_gives_its_waiting_grants_back_and_its_store_free() {
    let mut session = rendering();
    let close = Event::Received(CloseShot { shot: ShotId(1) }.into());
    assert_eq!(after(&mut session, [close]), ["hand back 1", "close shot-1", "release"]);
    assert_eq!(after(&mut session, [Event::Rendered(done(1))]), ["done lease-1"]);
}

#[test]
fn a_slow_link_holds_rendering_back() {
    let mut session = rendering();
    assert_eq!(after(&mut session, [Event::Rendered(done(1))]), ["done lease-1"]);
    let wants = after(&mut session, [grant(3, 1)]);
    assert_eq!(wants, ["glance shot-1 0"], "no job before the first is sent");
    assert_eq!(after(&mut session, [Event::Sent]).len(), 1);
}

#[test]
fn thousands_of_missing_tiles_are_asked_for_a_few_at_a_time() {
    let mut session = rendering();
    let hash =
        |i: u16| BlobHash(std::array::from_fn(|at| if at < 2 { i.to_le_bytes()[at] } else { 7 }));
    let missing: Vec<_> = (0..3000).map(hash).collect();
    after(&mut session, [Event::Paused(LeaseId(1), missing.clone())]);
    let mut asked = Vec::new();
    let mut outstanding = 0;
    for &hash in &missing {
        session.handle(Event::Absent(hash));
    }
    loop {
        while let Some(action) = session.poll_action() {
            match action {
                Action::Send(Message::WantBlobs(want)) => {
                    outstanding += want.hashes.len();
                    assert!(outstanding <= ASKED_MAX);
                    asked.extend(want.hashes);
                }
                Action::Take(blob) => session.handle(Event::Loaded(blob.hash)),
                Action::Resume(_) => {
                    asked.sort_unstable();
                    asked.dedup();
                    assert_eq!(asked.len(), missing.len());
                    return;
                }
                _ => {}
            }
        }
        let next = asked[asked.len() - outstanding];
        outstanding -= 1;
        session.handle(Event::Received(blob(next).into()));
    }
}

#[test]
fn the_way_ahead_is_looked_at_view_by_view_and_fetched_a_few_at_a_time() {
    let mut session = rendering();
    assert_eq!(after(&mut session, [ahead(1, 5, 3)]), ["glance shot-1 0"]);
    let foreseen: Vec<_> = (0..6).map(tile).collect();
    let seek: Vec<_> = foreseen.iter().map(|hash| format!("seek {hash}")).collect();
    assert_eq!(after(&mut session, [Event::Glanced(foreseen.clone())]), seek[..EARLY_MAX]);
    // The first is asked for, the second is here.
    assert_eq!(after(&mut session, [Event::Absent(tile(0))]), ["want 1"]);
    assert_eq!(after(&mut session, [Event::Stocked(tile(1))]), seek[4..5]);
    let stock = after(&mut session, [Event::Received(blob(tile(0)).into())]);
    assert_eq!(stock, [format!("stock {}", tile(0))]);
    let wants = after(&mut session, [Event::Stocked(tile(0))]);
    assert_eq!(wants, [seek[5].clone(), "glance shot-1 5".to_owned()], "the next view");
    for number in 2..6 {
        assert!(after(&mut session, [Event::Stocked(tile(number))]).is_empty());
    }
    assert_eq!(after(&mut session, [Event::Glanced(foreseen)]), ["glance shot-1 15"], "all here");
    assert!(after(&mut session, [Event::Glanced(Vec::new())]).is_empty());
    // Only what is new of a later message is looked at: frame 35 and 45.
    assert_eq!(after(&mut session, [ahead(1, 15, 4)]), ["glance shot-1 25"]);
    assert_eq!(after(&mut session, [Event::Glanced(Vec::new())]), ["glance shot-1 35"]);
    assert!(after(&mut session, [Event::Glanced(Vec::new())]).is_empty());
}

#[test]
fn what_a_job_waits_for_goes_first_and_what_is_on_its_way_is_not_asked_again() {
    let mut session = rendering();
    after(&mut session, [ahead(1, 5, 1)]);
    after(&mut session, [Event::Glanced((0..3).map(tile).collect())]);
    assert_eq!(after(&mut session, [Event::Absent(tile(0))]), ["want 1"]);
    let wants = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(0), tile(1), tile(9)])]);
    assert_eq!(wants, [format!("load {}", tile(9))], "two are on their way");
    assert!(after(&mut session, [Event::Absent(tile(2))]).is_empty(), "not now");
    assert_eq!(after(&mut session, [Event::Absent(tile(1))]), ["want 1"], "a job waits for it");
    let taken = after(&mut session, [Event::Received(blob(tile(0)).into())]);
    assert_eq!(taken, [format!("take {}", tile(0))]);
    after(&mut session, [Event::Loaded(tile(0)), Event::Loaded(tile(9))]);
    after(&mut session, [Event::Received(blob(tile(1)).into())]);
    let wants = after(&mut session, [Event::Loaded(tile(1))]);
    assert_eq!(wants, ["resume lease-1", "want 1"], "now for the rest");
}

#[test]
fn without_room_nothing_is_fetched_before_its_turn_until_the_next_job() {
    let mut session = rendering();
    after(&mut session, [ahead(1, 5, 2)]);
    after(&mut session, [Event::Glanced((0..9).map(tile).collect())]);
    for number in 0..4 {
        assert!(after(&mut session, [Event::NoRoom(tile(number))]).is_empty());
    }
    after(&mut session, [Event::Rendered(done(1)), Event::Sent]);
    let wants = after(&mut session, [Event::Loaded(INDEX)]);
    assert_eq!(wants, ["start lease-2", "glance shot-1 5"]);
}

#[test]
fn other_workers_are_asked_and_the_coordinator_if_they_fail() {
    let mut session = rendering();
    let both = vec![tile(1), tile(2)];
    after(&mut session, [Event::Paused(LeaseId(1), both)]);
    after(&mut session, [Event::Absent(tile(1)), Event::Absent(tile(2))]);
    let fetch = |number| [format!("fetch {}", tile(number))];
    assert_eq!(after(&mut session, [elsewhere(tile(1))]), fetch(1));
    assert_eq!(after(&mut session, [elsewhere(tile(2))]), fetch(2));
    let taken = after(&mut session, [Event::Fetched(blob(tile(1)))]);
    assert_eq!(taken, [format!("take {}", tile(1))]);
    session.handle(Event::Unfetched(tile(2)));
    let want: Message = WantBlobs { hashes: vec![tile(2)], elsewhere: false }.into();
    assert_eq!(session.poll_action(), Some(Action::Send(want)));
}

#[test]
fn damaged_blobs_are_asked_for_again_and_not_for_ever() {
    let mut session = rendering();
    after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1)]), Event::Absent(tile(1))]);
    for _ in 0..2 {
        let taken = after(&mut session, [Event::Received(blob(tile(1)).into())]);
        assert_eq!(taken, [format!("take {}", tile(1))]);
        session.handle(Event::Damaged(tile(1)));
        let want: Message = WantBlobs { hashes: vec![tile(1)], elsewhere: false }.into();
        assert_eq!(session.poll_action(), Some(Action::Send(want)));
    }
    after(&mut session, [Event::Received(blob(tile(1)).into())]);
    let said = after(&mut session, [Event::Damaged(tile(1))]);
    assert!(said[1].ends_with("what came has another hash"), "{said:?}");
}

/// A live shot's job that has begun, and lacks tile 1 and tile 2.
fn live_job_that_lacks_two() -> Session {
    let mut session = Session::new();
    after(&mut session, [open(LIVE), grant(1, LIVE), Event::Loaded(INDEX)]);
    let said = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1), tile(2)])]);
    assert_eq!(said, [format!("load {}", tile(1)), format!("load {}", tile(2))]);
    session
}

#[test]
fn a_live_job_waits_for_what_is_on_this_pc_and_settles_for_the_rest_which_is_asked_for() {
    let mut session = live_job_that_lacks_two();
    assert_eq!(after(&mut session, [Event::Absent(tile(1))]), ["want 1"]);
    assert_eq!(after(&mut session, [Event::Absent(tile(2))]), ["settle lease-1", "want 1"]);
    assert_eq!(after(&mut session, [Event::Rendered(done(1))]), ["done lease-1"]);
    // It comes for the next one.
    let said = after(&mut session, [Event::Received(blob(tile(1)).into())]);
    assert_eq!(said, [format!("take {}", tile(1))]);
    assert!(after(&mut session, [Event::Loaded(tile(1)), Event::Sent]).is_empty());

    let mut session = live_job_that_lacks_two();
    assert_eq!(after(&mut session, [Event::Absent(tile(1))]), ["want 1"]);
    assert_eq!(after(&mut session, [Event::Loaded(tile(2))]), ["resume lease-1"]);
    // It is on its way: nothing to wait for on this PC.
    let said = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1)])]);
    assert_eq!(said, ["settle lease-1"]);
}

#[test]
fn a_live_job_with_nothing_to_show_waits_until_there_is_something() {
    let mut session = live_job_that_lacks_two();
    after(&mut session, [Event::Absent(tile(1)), Event::Absent(tile(2))]);
    // The root of the pyramid.
    let said = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(3)])]);
    assert_eq!(said, [format!("load {}", tile(3))]);
    assert_eq!(after(&mut session, [Event::Absent(tile(3))]), ["want 1"]);
    let root = Event::Received(blob(tile(3)).into());
    assert_eq!(after(&mut session, [root]), [format!("take {}", tile(3))]);
    assert_eq!(after(&mut session, [Event::Loaded(tile(3))]), ["resume lease-1"]);
    let said = after(&mut session, [Event::Paused(LeaseId(1), vec![tile(1), tile(2)])]);
    assert_eq!(said, ["settle lease-1"]);
}

/// A world that answers in any order, and keeps the rules in view.
#[derive(Default)]
struct World {
    /// Granted, not answered, not revoked.
    held: BTreeSet<u64>,
    answered: BTreeSet<u64>,
    memory: BTreeSet<BlobHash>,
    loading: Vec<BlobHash>,
    /// Looked for, or being kept, for later.
    early: Vec<BlobHash>,
    /// Those of them for which a job came to wait.
    hurried: BTreeSet<BlobHash>,
    asked: Vec<BlobHash>,
    /// Asked of other workers.
    fetching: Vec<BlobHash>,
    glancing: bool,
    running: Option<u64>,
    paused: Option<u64>,
    needs: BTreeSet<BlobHash>,
    /// What the last live job lacked.
    lacked: BTreeSet<BlobHash>,
    /// Leases of the live shot.
    live: BTreeSet<u64>,
    /// The job has settled, and waits again or renders.
    settled: bool,
    unsent: usize,
    ended: bool,
}

impl World {
    fn carry_out(&mut self, session: &mut Session) {
        while let Some(action) = session.poll_action() {
            assert!(!self.ended, "{action:?} after the end");
            match action {
                Action::Send(message) => {
                    if let (Message::WantBlobs(want), Doing::Waiting) = (&message, session.doing())
                    {
                        let needed = |hash| {
                            self.needs.contains(hash)
                                || self.lacked.contains(hash)
                                || *hash == INDEX
                        };
                        assert!(want.hashes.iter().all(needed), "for later while a job waits");
                    }
                    self.hear(&message);
                }
                Action::Seek(hash) => {
                    assert!(!self.loading.contains(&hash) && !self.early.contains(&hash));
                    self.early.push(hash);
                    assert!(self.early.len() - self.hurried.len() <= EARLY_MAX);
                }
                Action::Stock(blob) => self.early.push(blob.hash),
                Action::Fetch(elsewhere) => {
                    assert!(self.fetching.contains(&elsewhere.hash));
                }
                Action::Glance(glance, shot) => {
                    assert!(self.memory.contains(&shot.index) && shot.shot == glance.shot);
                    assert!(!std::mem::replace(&mut self.glancing, true), "one at a time");
                }
                Action::Close(_) => {}
                Action::Load(hash) => {
                    assert!(!self.loading.contains(&hash), "loaded twice");
                    self.loading.push(hash);
                }
                Action::Take(blob) => self.loading.push(blob.hash),
                Action::Start(grant, shot) => {
                    assert!(self.memory.contains(&shot.index), "no render before its index");
                    assert_eq!((self.running, self.paused), (None, None), "one job at a time");
                    self.running = Some(grant.lease.0);
                    self.settled = false;
                }
                Action::Resume(lease) => {
                    let lenient = self.live.contains(&lease.0) && !self.settled;
                    let some = !self.needs.is_disjoint(&self.memory);
                    let all = self.needs.is_subset(&self.memory);
                    assert!(if lenient { some } else { all }, "no render before its tiles");
                    assert_eq!((self.running, self.paused.take()), (None, Some(lease.0)));
                    self.running = Some(lease.0);
                    self.settled = false;
                }
                Action::Settle(lease) => {
                    assert!(self.live.contains(&lease.0) && !self.settled, "it can wait");
                    assert_eq!((self.running, self.paused.take()), (None, Some(lease.0)));
                    self.running = Some(lease.0);
                    self.settled = true;
                }
                Action::Stop(lease) => assert_eq!(self.running, Some(lease.0)),
                Action::Discard(lease) => assert_eq!(self.paused.take(), Some(lease.0)),
                Action::Release(_) => {}
                Action::End => {
                    assert!(self.held.is_empty() && self.unsent == 0, "left with {:?}", self.held);
                    self.ended = true;
                }
            }
        }
    }

    fn hear(&mut self, message: &Message) {
        match message {
            Message::Done(done) => {
                self.unsent += 1;
                self.answer(done.lease.0);
            }
            Message::Failed(failed) => self.answer(failed.lease.0),
            Message::HandBack(back) => back.leases.iter().for_each(|lease| self.answer(lease.0)),
            Message::WantBlobs(want) => {
                for hash in &want.hashes {
                    assert!(!self.asked.contains(hash), "asked twice");
                    self.asked.push(*hash);
                }
            }
            _ => {}
        }
    }

    fn answer(&mut self, lease: u64) {
        assert!(self.held.remove(&lease), "lease-{lease} is not held");
        assert!(self.answered.insert(lease), "lease-{lease} answered twice");
    }

    /// The next event of a kind that is possible now.
    fn event(&mut self, kind: u8, pick: u8, next_lease: &mut u64) -> Option<Event> {
        let pick_of = |list: &mut Vec<BlobHash>| {
            (!list.is_empty()).then(|| list.swap_remove(usize::from(pick) % list.len()))
        };
        let from_pool = |world: &mut World| world.running.take().map(LeaseId);
        match kind {
            0..=3 => {
                *next_lease += 1;
                self.held.insert(*next_lease);
                let shot = 1 + u64::from(pick % 3);
                if shot == LIVE {
                    self.live.insert(*next_lease);
                }
                Some(grant(*next_lease, shot))
            }
            4 => Some(open(1 + u64::from(pick % 3))),
            5 => Some(Event::Received(CloseShot { shot: ShotId(1 + u64::from(pick % 3)) }.into())),
            6 => {
                let lease = *self.held.iter().nth(usize::from(pick) % self.held.len().max(1))?;
                self.held.remove(&lease);
                Some(revoke(lease))
            }
            7 | 8 => pick_of(&mut self.loading).map(|hash| {
                self.memory.insert(hash);
                Event::Loaded(hash)
            }),
            9 => pick_of(&mut self.loading).map(Event::Absent),
            10 => pick_of(&mut self.loading).map(|hash| Event::Spoiled(hash, "torn".into())),
            11 | 12 => pick_of(&mut self.asked).map(|hash| Event::Received(blob(hash).into())),
            13 => pick_of(&mut self.asked)
                .map(|hash| Event::Received(NoBlob { hash, why: "gone".into() }.into())),
            14 => from_pool(self).map(|lease| {
                self.paused = Some(lease.0);
                self.needs = (0..1 + pick % 4).map(|i| tile(i + pick % 16)).collect();
                self.hurried.extend(self.early.iter().filter(|hash| self.needs.contains(hash)));
                self.needs.iter().for_each(|hash| {
                    self.memory.remove(hash);
                });
                if self.live.contains(&lease.0) && !self.settled {
                    self.lacked = self.needs.clone();
                }
                Event::Paused(lease, self.needs.iter().copied().collect())
            }),
            15 | 16 => from_pool(self).map(|lease| Event::Rendered(done(lease.0))),
            17 => from_pool(self).map(|lease| Event::Broken(lease, "panic".into())),
            18 | 19 if self.unsent > 0 => {
                self.unsent -= 1;
                Some(Event::Sent)
            }
            20 if pick < 8 => Some(Event::Leave("told".into())),
            21 => Some(ahead(1 + u64::from(pick % 3), u32::from(pick), 1 + usize::from(pick % 4))),
            22 | 23 if self.glancing => {
                self.glancing = false;
                Some(Event::Glanced((0..pick % 12).map(|i| tile(i + pick % 16)).collect()))
            }
            24..=26 => pick_of(&mut self.early).map(|hash| {
                self.hurried.remove(&hash);
                [Event::Stocked(hash), Event::Absent(hash), Event::NoRoom(hash)][kind as usize - 24]
                    .clone()
            }),
            27 => pick_of(&mut self.asked).map(|hash| {
                self.fetching.push(hash);
                elsewhere(hash)
            }),
            28 => pick_of(&mut self.fetching).map(|hash| Event::Fetched(blob(hash))),
            29 => pick_of(&mut self.fetching).map(Event::Unfetched),
            30 => pick_of(&mut self.loading).map(Event::Damaged),
            _ => None,
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_every_lease_is_answered_once_and_one_job_runs(
        script in prop::collection::vec((0u8..=30, any::<u8>()), 0..200),
    ) {
        let (mut session, mut world, mut lease) = (Session::new(), World::default(), 0);
        session.handle(open(1));
        for (kind, pick) in script {
            if world.ended {
                break;
            }
            if let Some(event) = world.event(kind, pick, &mut lease) {
                session.handle(event);
                world.carry_out(&mut session);
            }
        }
        // From here on the world is kind, and everything comes to an end.
        if !world.ended {
            session.handle(Event::Leave("told".into()));
            world.carry_out(&mut session);
        }
        for _ in 0..2000 {
            for kind in [7, 11, 15, 18, 24, 28] {
                if let Some(event) = world.event(kind, 0, &mut lease) {
                    session.handle(event);
                    world.carry_out(&mut session);
                }
            }
            if world.ended {
                break;
            }
        }
        prop_assert!(world.ended, "still held: {:?}", world.held);
        prop_assert!(world.held.is_empty());
    }
}
