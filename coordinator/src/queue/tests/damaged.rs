//! Records that are damaged one by one, in a database that is whole: each costs its own shot
//! or frame. And terrain that is damaged: it is asked for again, all of it at once.

use super::house::{House, Land, plan, until};
use super::*;
use redb::{Database, ReadableTable, TableDefinition};
use std::time::Instant;

const SHOTS_TABLE: TableDefinition<u64, &[u8]> = TableDefinition::new("shots");
const FRAMES_TABLE: TableDefinition<(u64, u32), &[u8]> = TableDefinition::new("frames");

/// The records of a queue that was cut off.
fn database(folder: &Path) -> Database {
    // Its threads may still hold the file for a moment.
    let deadline = Instant::now() + house::PATIENCE;
    loop {
        match Database::create(folder.join("queue.redb")) {
            Ok(database) => return database,
            Err(why) => assert!(Instant::now() < deadline, "{why}"),
        }
    }
}

/// Changes the text of a shot's record.
fn change_shot(folder: &Path, shot: u64, change: impl Fn(String) -> String) {
    let transaction = database(folder).begin_write().unwrap();
    {
        let mut table = transaction.open_table(SHOTS_TABLE).unwrap();
        let text = String::from_utf8(table.get(shot).unwrap().unwrap().value().to_vec()).unwrap();
        let changed = change(text.clone());
        assert_ne!(changed, text);
        table.insert(shot, changed.as_bytes()).unwrap();
    }
    transaction.commit().unwrap();
}

fn damage_frame(folder: &Path, shot: u64, index: FrameIndex) {
    let transaction = database(folder).begin_write().unwrap();
    {
        let mut table = transaction.open_table(FRAMES_TABLE).unwrap();
        assert!(table.insert((shot, index), &b"{\"done\":"[..]).unwrap().is_some());
    }
    transaction.commit().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_shot_whose_record_is_damaged_fails_with_the_reason_and_the_others_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    for name in ["cut", "ridge", "unknown", "absurd", "sound"] {
        let mut plan = plan(&land, 3);
        (plan.name, plan.first_frame) = (name.into(), 70);
        house.queue.submit(plan).await.unwrap();
    }
    let config = house.cut_off();
    change_shot(folder.path(), 1, |text| text[..text.len() / 2].to_owned());
    change_shot(folder.path(), 2, |text| text.replace("\"fps\"", "\"fqs\""));
    change_shot(folder.path(), 3, |text| text.replace("\"exact\"", "\"guess\""));
    change_shot(folder.path(), 4, |text| text.replace("[32,16]", "[0,4294967295]"));
    let house = House::with(config).await;
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[4].state == ShotState::Done).await;
    for (at, name) in [(0, "unreadable"), (1, "ridge"), (2, "unknown"), (3, "absurd")] {
        let shot = &house.queue.shots()[at];
        assert_eq!((shot.state, shot.name.as_str()), (ShotState::Failed, name));
        assert!(shot.note.contains("its record is damaged: "), "{}", shot.note);
    }
    let known = house.queue.shot(ShotId(2)).unwrap();
    assert_eq!((known.first_frame, known.frames, known.size), (70, 3, [32, 16]));
    let cancel = house.queue.order(Order::Cancel(ShotId(1))).await;
    assert!(matches!(cancel, Err(QueueError::Over { .. })), "{cancel:?}");
    assert_eq!(house.queue.submit(plan(&land, 1)).await.unwrap(), ShotId(6));
    // What is on the disk was left as it is: mended, the shot would go on.
    let config = house.cut_off();
    change_shot(folder.path(), 2, |text| text.replace("\"fqs\"", "\"fps\""));
    let house = House::with(config).await;
    assert_eq!(house.queue.shot(ShotId(1)).unwrap().state, ShotState::Failed);
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[1].state == ShotState::Done).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frame_whose_record_is_damaged_is_rendered_again_and_holds_up_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    for _ in 0..2 {
        house.queue.submit(plan(&land, 4)).await.unwrap();
    }
    let _worker = house.hire_for(WorkerId(1), 2).await;
    let done = |list: &ShotList| list.iter().map(|shot| shot.frames_done).sum::<u32>();
    until(&house.queue, |list| done(list) == 2).await;
    let damaged = house.log()[0];
    let config = house.cut_off();
    damage_frame(folder.path(), damaged.0.0, damaged.1);
    let house = House::with(config).await;
    let why = house.queue.order(Order::Why(damaged.0, damaged.1)).await.unwrap();
    assert!(why.contains("its record is damaged"), "{why}");
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list.iter().all(|shot| shot.state == ShotState::Done)).await;
    assert!(house.log().contains(&damaged), "it was rendered again");
    for shot in [1, 2] {
        let files = house.queue.files(ShotId(shot)).unwrap();
        assert_eq!(manifest(&files).frames.len(), 4);
        assert_eq!(house.queue.shot(ShotId(shot)).unwrap().frames_done, 4);
    }
}

fn blob_path(folder: &Path, hash: BlobHash) -> PathBuf {
    let name = hash.to_hex();
    folder.join("blobs").join(&name[..2]).join(name)
}

/// What the disk cannot read and what is not what it should be is asked for, and what is sent
/// takes its place: one question and one answer are enough, whatever was damaged.
#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn terrain_that_is_damaged_in_every_way_is_mended_by_sending_it_once_more() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let tiles: Vec<_> = land.blobs[1..].iter().map(|(hash, _)| *hash).collect();
    assert!(tiles.len() > 2, "{}", tiles.len());
    house.queue.submit(plan(&land, 3)).await.unwrap();
    let all: Vec<_> = land.blobs.iter().map(|(hash, _)| *hash).collect();
    assert_eq!(house.queue.missing_blobs(all.clone()).await.unwrap(), []);
    // Of the right length with other bytes, cut off, and one that can be opened and not read.
    let mut bytes = fs::read(blob_path(folder.path(), tiles[0])).unwrap();
    bytes[0] ^= 1;
    fs::write(blob_path(folder.path(), tiles[0]), &bytes).unwrap();
    fs::write(blob_path(folder.path(), tiles[1]), &bytes[..3]).unwrap();
    fs::remove_file(blob_path(folder.path(), tiles[2])).unwrap();
    std::os::unix::fs::symlink("/proc/self/mem", blob_path(folder.path(), tiles[2])).unwrap();
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[0].state == ShotState::Stalled).await;
    let note = house.queue.shots()[0].note.clone();
    assert!(note.contains("submit the terrain again"), "{note}");
    let missing = house.queue.missing_blobs(all).await.unwrap();
    assert_eq!(missing, tiles[..3]);
    for (hash, bytes) in land.blobs.iter().filter(|(hash, _)| missing.contains(hash)) {
        house.queue.put_blob(*hash, bytes.clone()).await.unwrap();
    }
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    assert_eq!(house.queue.shots()[0].frames_failed, 0);
    assert!(fs::symlink_metadata(blob_path(folder.path(), tiles[2])).unwrap().is_file());
}
