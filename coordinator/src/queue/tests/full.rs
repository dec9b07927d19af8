//! A disk that is full: a small one of its own where the test may mount one, as root on
//! Linux. And the folder of one shot that takes no files, which costs that shot alone.

use super::house::{self, House, Land, plan, until};
use super::*;
use std::process::Command;

/// A file system in memory that is unmounted with the test.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    /// `None` where nobody may mount.
    fn new(size: &str) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"]).arg(folder.path());
        let mounted = mount.output().is_ok_and(|output| output.status.success());
        if !mounted {
            println!("skipped: no file system can be mounted here");
            return None;
        }
        Some(SmallDisk(folder))
    }

    /// Takes all the room but so many bytes.
    fn fill(&self, left: u64) {
        let free = disk::free_bytes(self.0.path()).unwrap();
        fs::write(self.0.path().join("filler"), vec![1; free.saturating_sub(left) as usize])
            .unwrap();
    }

    fn empty(&self) {
        fs::remove_file(self.0.path().join("filler")).unwrap();
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).output();
    }
}

/// With every share of a small disk left when the shot begins, the queue stalls with a
/// message and goes on by itself; what was finished is not rendered again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_stalls_the_queue_until_there_is_room() {
    let Some(small) = SmallDisk::new("24m") else { return };
    let elsewhere = tempfile::tempdir().unwrap();
    let land = Land::new(elsewhere.path());
    let house = House::with(house::config(small.0.path())).await;
    land.send(&house.queue).await;
    let mut finished = Vec::new();
    for left in [0, 4 << 10, 32 << 10, 100 << 10, 300 << 10] {
        let shot = house.queue.submit(plan(&land, 120)).await.unwrap();
        let at = finished.len();
        small.fill(left);
        let worker = house.hire(WorkerId(1 + left)).await;
        until(&house.queue, |list| list[at].state == ShotState::Stalled).await;
        let view = house.queue.shot(shot).unwrap();
        assert!(view.note.contains("no space left in"), "{}", view.note);
        assert!(view.note.contains(small.0.path().to_str().unwrap()), "{}", view.note);
        small.empty();
        until(&house.queue, |list| list[at].state == ShotState::Done).await;
        worker.abort();
        finished.push(shot);
        let mut frames = house.rendered_of(shot);
        let rendered = frames.len();
        frames.sort_unstable();
        frames.dedup();
        assert_eq!(frames, (0..120).collect::<Vec<_>>(), "with {left} bytes left");
        // Jobs that ran when the farm was told to wait were not finished.
        assert!(rendered <= 120 + 3, "{rendered} frames were rendered with {left} bytes left");
    }
}

/// A submission is refused, not half-taken; and orders hold within the reserve.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn within_the_reserve_orders_hold_and_submissions_are_refused() {
    let Some(small) = SmallDisk::new("24m") else { return };
    let elsewhere = tempfile::tempdir().unwrap();
    let land = Land::new(elsewhere.path());
    let mut config = house::config(small.0.path());
    config.reserve_bytes = 4 << 20;
    let mut house = House::with(config).await;
    land.send(&house.queue).await;
    let shot = house.queue.submit(plan(&land, 20)).await.unwrap();
    small.fill(2 << 20);
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[0].state == ShotState::Stalled).await;
    let refused = house.queue.submit(plan(&land, 1)).await.unwrap_err();
    assert!(matches!(refused, QueueError::DiskFull { .. }), "{refused}");
    house.queue.order(Order::Pause(shot)).await.unwrap();
    house = house.restart().await;
    assert_eq!(house.queue.shot(shot).unwrap().state, ShotState::Paused);
    house.queue.order(Order::Resume(shot)).await.unwrap();
    small.empty();
    let _worker = house.hire(WorkerId(2)).await;
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    assert_eq!(house.queue.shots().len(), 1);
}

/// The folder of the first shot takes no picture, that of the second no manifest: both wait
/// with the reason, the third is done, and so are they when their folders are mended.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_folder_that_fails_holds_up_its_own_shot() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let shots = folder.path().join("shots");
    let manifest = shots.join("000002/manifest.json");
    fs::create_dir_all(&manifest).unwrap();
    fs::write(shots.join("000001"), "no folder").unwrap();
    for _ in 0..3 {
        house.queue.submit(plan(&land, 12)).await.unwrap();
    }
    let _worker = house.hire(WorkerId(1)).await;
    let states = |list: &ShotList| list.iter().map(|shot| shot.state).collect::<Vec<_>>();
    use ShotState::{Done, Stalled};
    until(&house.queue, |list| states(list) == [Stalled, Stalled, Done]).await;
    for (shot, place) in [(1, "000001"), (2, "manifest.json")] {
        let note = house.queue.shot(ShotId(shot)).unwrap().note.clone();
        assert!(note.contains(place), "{note}");
    }
    fs::remove_file(shots.join("000001")).unwrap();
    fs::remove_dir(&manifest).unwrap();
    until(&house.queue, |list| states(list) == [Done, Done, Done]).await;
    let mut frames = house.log();
    // Jobs that ran when the farm was told to wait were not finished.
    assert!(frames.len() <= 36 + 3, "{} frames were rendered", frames.len());
    frames.sort_unstable();
    frames.dedup();
    assert_eq!(frames.len(), 36);
}
