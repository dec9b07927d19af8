//! kill -9 at random moments: of the task inside this process, and of a whole process that
//! runs farm, queue and workers.

use super::super::ledger::{FrameRecord, Ledger, ShotRecord, Stage};
use super::house::{self, House, Land, plan, until, work};
use super::*;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::time::Instant;

/// Tells the child what to do.
const FOLDER: &str = "TERRAFARM_TEST_QUEUE";
const FRAMES: u32 = 60;
const SHOTS: u64 = 3;

/// What is recorded as finished, and where.
fn recorded(folder: &Path) -> BTreeSet<(ShotId, FrameIndex)> {
    // Its threads may still hold the file for a moment.
    let deadline = Instant::now() + house::PATIENCE;
    let mut ledger = loop {
        match Ledger::open(&folder.join("queue.redb")) {
            Ok(ledger) => break ledger,
            Err(why) => assert!(Instant::now() < deadline, "{why}"),
        }
    };
    let (_, saved) = ledger.load().unwrap();
    let mut all = BTreeSet::new();
    for shot in saved {
        for (index, record) in ledger.frames(shot.id).unwrap() {
            let Some(FrameRecord::Done { bytes, .. }) = record else { panic!("{record:?}") };
            let path = picture(&shot_folder(folder, shot.id), index);
            assert_eq!(fs::metadata(path).unwrap().len(), bytes, "a record without its picture");
            all.insert((shot.id, index));
        }
    }
    all
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_film_that_is_being_made_does_not_hold_up_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let shot = ShotId(1);
    let mut plan = plan(&land, 1);
    (plan.film, plan.size) = (Some(Film::Mp4), [1280, 720]);
    plan.cameras.clear();
    // Hours of marked pictures: none of them is on the disk.
    let record = ShotRecord {
        plan,
        frames: 1 << 20,
        submitted_s: 0,
        stage: Stage::Finishing,
        note: String::new(),
        workers: Vec::new(),
        history: Vec::new(),
    };
    let mut ledger = Ledger::open(&folder.path().join("queue.redb")).unwrap();
    ledger.add(shot, &record, &[], None).unwrap();
    drop(ledger);
    fs::create_dir_all(shot_folder(folder.path(), shot)).unwrap();
    let house = House::open(folder.path()).await;
    let deadline = Instant::now() + house::PATIENCE;
    while fs::read_dir(shot_folder(folder.path(), shot)).unwrap().next().is_none() {
        assert!(Instant::now() < deadline, "the film is not begun");
        tokio::task::yield_now().await;
    }
    // It cannot be opened again before the threads of the one before have ended.
    house.restart().await.cut_off();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_task_that_is_cut_off_anywhere_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    for _ in 0..SHOTS {
        house.queue.submit(plan(&land, FRAMES)).await.unwrap();
    }
    let mut before = BTreeSet::new();
    for round in 0..12 {
        let _worker = house.hire_for(WorkerId(1), 7 + round).await;
        let shown = round as u32;
        until(&house.queue, |list| {
            list.iter().map(|shot| shot.frames_done).sum::<u32>() as usize >= before.len() + 2
                || list.iter().all(|shot| shot.state == ShotState::Done)
        })
        .await;
        let acknowledged: u32 = house.queue.shots().iter().map(|shot| shot.frames_done).sum();
        let again: Vec<_> =
            house.log().into_iter().filter(|frame| before.contains(frame)).collect();
        assert!(again.is_empty(), "round {shown} rendered {again:?} again");
        let config = house.cut_off();
        before = recorded(&config.folder);
        assert!(before.len() as u32 >= acknowledged, "what was shown is lost");
        house = House::with(config).await;
    }
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list.iter().all(|shot| shot.state == ShotState::Done)).await;
    assert_eq!(recorded_all(&house.cut_off().folder), SHOTS as usize * FRAMES as usize);
}

fn recorded_all(folder: &Path) -> usize {
    recorded(folder).len()
}

/// Not a test by itself: the process that the next one kills. It prints a line for each
/// shot that was acknowledged and each frame that is rendered.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn child() {
    let Ok(folder) = std::env::var(FOLDER) else { return };
    let folder = PathBuf::from(folder);
    let land = Land::new(&folder);
    let house = House::open(&folder).await;
    let log = house::Log::default();
    tokio::spawn(work(house.line.clone(), WorkerId(1), usize::MAX, log.clone()));
    land.send(&house.queue).await;
    while house.queue.shots().len() < SHOTS as usize {
        let shot = house.queue.submit(plan(&land, FRAMES)).await.unwrap();
        say(&format!("took {}", shot.0));
    }
    let mut said = 0;
    loop {
        for (shot, frame) in log.lock().unwrap().iter().skip(said) {
            said += 1;
            say(&format!("rendered {} {frame}", shot.0));
        }
        if house.queue.shots().iter().all(|shot| shot.state == ShotState::Done) {
            return say("done");
        }
        tokio::task::yield_now().await;
    }
}

/// Around the capture of the test harness.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    out.write_all(format!("\n> {line}\n").as_bytes()).unwrap();
    out.flush().unwrap();
}

#[test]
fn a_process_that_is_killed_at_any_moment_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let (mut taken, mut finished) = (BTreeSet::new(), BTreeSet::new());
    let mut kills = BTreeMap::from([("early", 0), ("late", 0)]);
    for round in 0..40u64 {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "queue::tests::killed::child", "--nocapture"])
            .env(FOLDER, folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        // After so many lines, and then at no moment in particular.
        let mut left = 1 + (round * 7) % 23;
        let (mut rendered, mut is_done) = (Vec::new(), false);
        for line in lines.map_while(Result::ok) {
            let Some(said) = line.strip_prefix("> ") else { continue };
            let words: Vec<_> = said.split(' ').collect();
            match words[..] {
                ["took", shot] => drop(taken.insert(ShotId(shot.parse().unwrap()))),
                ["rendered", shot, frame] => {
                    let shot = ShotId(shot.parse().unwrap());
                    rendered.push((shot, frame.parse::<FrameIndex>().unwrap()));
                }
                _ => is_done = true,
            }
            left -= 1;
            if left == 0 && !is_done {
                child.kill().unwrap();
                *kills.get_mut(if finished.is_empty() { "early" } else { "late" }).unwrap() += 1;
            }
            if left == 0 || is_done {
                break;
            }
        }
        child.wait().unwrap();
        let again: Vec<_> = rendered.iter().filter(|frame| finished.contains(*frame)).collect();
        assert!(again.is_empty(), "round {round} rendered {again:?} again");
        if folder.path().join("queue.redb").exists() {
            let now = recorded(folder.path());
            assert!(now.is_superset(&finished), "round {round} lost frames");
            finished = now;
            let mut ledger = Ledger::open(&folder.path().join("queue.redb")).unwrap();
            let known: BTreeSet<_> =
                ledger.load().unwrap().1.into_iter().map(|shot| shot.id).collect();
            assert!(known.is_superset(&taken), "round {round} lost a shot");
        }
        if is_done {
            break;
        }
    }
    println!("killed {kills:?}, {} frames", finished.len());
    assert!(kills["late"] > 3, "{kills:?}");
    assert_eq!(finished.len(), SHOTS as usize * FRAMES as usize);
}
