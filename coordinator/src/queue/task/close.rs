//! What becomes durable: frames, ends of shots; and what happens when the disk says no.

use super::stay::Picture;
use super::{News, SWEEP, Task};
use crate::queue::ledger::{ShotRecord, Stage};
use crate::queue::pictures::{self, Unfinished};
use crate::queue::{KEY_KEPT, OVER_MAX, QueueError, blocking, disk};
use std::time::{Instant, SystemTime, UNIX_EPOCH};
use terrafarm_common::id::ShotId;
use tokio_util::sync::CancellationToken;

/// How often pictures or records of a shot may be found damaged before it is given up.
const LOSSES_MAX: u32 = 3;

impl Task {
    /// Records all frames that are over, in one transaction.
    pub async fn record(&mut self) {
        if self.outcomes.is_empty() || self.stalled.is_some() {
            return;
        }
        let outcomes = std::mem::take(&mut self.outcomes);
        let frames: Vec<_> =
            outcomes.iter().map(|frame| (frame.shot, frame.index, frame.record.clone())).collect();
        match self.ledger(move |ledger| ledger.record(&frames)).await {
            Ok(progress) => {
                tracing::debug!(frames = outcomes.len(), "frames recorded");
                for outcome in outcomes {
                    self.book.count_in_hand(outcome.shot, -1);
                    self.taken(outcome.stay, outcome.frame).await;
                }
                for (shot, progress) in progress {
                    self.book.advance(shot, progress);
                    self.changed.insert(shot);
                    self.check_complete(shot).await;
                }
            }
            Err(why) => {
                self.outcomes = outcomes;
                self.stall(why).await;
            }
        }
    }

    /// A shot all of whose frames are over gets its manifest and film. One whose stay ended
    /// without them goes to the farm again.
    pub async fn check_complete(&mut self, shot: ShotId) {
        let Some(state) = self.book.get(shot) else { return };
        let is_open = matches!(state.record.stage, Stage::Open | Stage::Paused);
        if !is_open || state.in_hand > 0 || !self.is_spent(shot) {
            return;
        }
        let finishing = state.is_complete().then(|| {
            let mut record = state.record.clone();
            record.stage = Stage::Finishing;
            record
        });
        self.leave(shot).await;
        if let Some(record) = finishing {
            self.keep_or_stall(shot, record).await;
        }
    }

    /// As [`Task::check_complete`], of every shot that is not in the farm.
    pub async fn check_all(&mut self) {
        let complete: Vec<_> =
            self.book.iter().filter(|(_, shot)| shot.is_complete()).map(|(id, _)| id).collect();
        for shot in complete {
            self.check_complete(shot).await;
        }
    }

    async fn keep_or_stall(&mut self, shot: ShotId, record: ShotRecord) {
        if let Err(why) = self.keep(shot, record).await {
            self.stall(why).await;
        }
    }

    /// A shot is given up, for a reason.
    pub async fn fail(&mut self, shot: ShotId, why: String) {
        let Some(state) = self.book.get(shot) else { return };
        tracing::warn!(%shot, "given up: {why}");
        let mut record = state.record.clone();
        record.stage = Stage::Failed;
        record.note = why;
        self.keep_or_stall(shot, record).await;
        self.give_up(shot).await;
    }

    /// A shot is over before its end.
    pub async fn give_up(&mut self, shot: ShotId) {
        self.leave(shot).await;
        self.losses.remove(&shot);
        self.book.set_stuck(shot, None);
        if let Some((_, guard)) = self.finishing.as_mut().filter(|(other, _)| *other == shot) {
            *guard = None;
        }
        let before = self.unwritten.len();
        self.unwritten.retain(|picture| picture.shot() != shot);
        self.book.count_in_hand(shot, self.unwritten.len() as isize - before as isize);
        self.close().await;
    }

    /// Begins to make manifest and film of the next shot that needs them.
    pub fn finish_next(&mut self) {
        if self.finishing.is_some() {
            return;
        }
        let Some(shot) = self.book.to_finish() else { return };
        let Some(state) = self.book.get(shot) else { return };
        let (record, files) = (state.record.clone(), self.files(shot, &state.record));
        let stop = CancellationToken::new();
        // Also stopped with the task: the program does not end before its threads.
        self.finishing = Some((shot, Some(stop.clone().drop_guard())));
        let (shared, tell) = (self.shared.clone(), self.tell.clone());
        self.errands.spawn(async move {
            let work = tokio::task::spawn_blocking(move || {
                let kept =
                    shared.with_ledger(|ledger| ledger.frames(shot)).map_err(Unfinished::Disk)?;
                let damaged = kept.iter().filter(|(_, frame)| frame.is_none());
                let damaged: Vec<_> = damaged.map(|(index, _)| *index).collect();
                if !damaged.is_empty() {
                    return Err(Unfinished::Lost(damaged));
                }
                let whole = kept.into_iter().filter_map(|(index, frame)| Some((index, frame?)));
                let frames = whole.collect();
                pictures::finish(&shared.config.folder, &files, &record, &frames, &stop)
            });
            let result = work.await.unwrap_or(Ok("there is no film: its encoder failed".into()));
            let _ = tell.send(News::Finished(shot, result)).await;
        });
    }

    /// A shot has its manifest and film, or not.
    pub async fn finished(&mut self, shot: ShotId, result: Result<String, Unfinished>) {
        self.finishing = None;
        let Some(state) = self.book.get(shot) else { return };
        if state.record.stage != Stage::Finishing {
            return;
        }
        let mut record = state.record.clone();
        match result {
            Ok(note) => {
                tracing::info!(%shot, name = %record.plan.name, "done");
                (record.stage, record.note) = (Stage::Done, note);
                self.losses.remove(&shot);
                self.keep_or_stall(shot, record).await;
                self.close().await;
            }
            Err(Unfinished::Lost(frames)) => {
                let losses = self.losses.entry(shot).or_default();
                *losses += 1;
                if *losses > LOSSES_MAX {
                    let why = "its pictures or their records were found damaged on the disk again and again";
                    return self.fail(shot, why.into()).await;
                }
                let count = frames.len();
                tracing::warn!(%shot, count, "pictures are damaged or gone and are rendered again");
                match self.ledger(move |ledger| ledger.unrecord(shot, &frames)).await {
                    Ok(progress) => {
                        self.book.advance(shot, progress);
                        record.stage = Stage::Open;
                        record.note =
                            format!("{count} pictures were damaged or gone and are rendered again");
                        record.happened(record.note.clone());
                        self.keep_or_stall(shot, record).await;
                    }
                    Err(why) => self.stall(why).await,
                }
            }
            Err(Unfinished::Disk(why)) => self.hold(shot, why).await,
            Err(Unfinished::Canceled) => {}
        }
    }

    /// Files of a shot cannot be written. On a full disk nobody's can; else it is the shot's
    /// own folder, and the others go on.
    pub async fn hold(&mut self, shot: ShotId, why: QueueError) {
        if !matches!(why, QueueError::Io { .. }) {
            return self.stall(why).await;
        }
        let is_new = self.book.get(shot).is_some_and(|state| state.stuck.is_none());
        if is_new {
            tracing::warn!(%shot, "the shot waits: {why}");
        }
        self.book.set_stuck(shot, Some(why));
        self.changed.insert(shot);
        self.sync_pause(shot).await;
    }

    /// Looks whether folders that failed can be written to again.
    async fn unstick(&mut self) {
        let stuck = self.book.iter().filter(|(_, shot)| shot.stuck.is_some());
        let folders: Vec<_> =
            stuck.map(|(id, shot)| (id, self.files(id, &shot.record).folder)).collect();
        for (shot, folder) in folders {
            let queue = self.shared.config.folder.clone();
            if let Err(why) = blocking(move || disk::probe(&queue, &folder)).await {
                self.hold(shot, why).await;
                continue;
            }
            self.book.set_stuck(shot, None);
            self.changed.insert(shot);
            self.write_waiting(Some(shot));
            self.sync_pause(shot).await;
        }
    }

    /// Writes the pictures for which there was no room, of one shot or of all.
    fn write_waiting(&mut self, only: Option<ShotId>) {
        let is_due = |picture: &mut Picture| only.is_none_or(|shot| picture.shot() == shot);
        for picture in self.unwritten.extract_if(.., is_due).collect::<Vec<_>>() {
            self.write(picture);
        }
    }

    /// The disk is full or fails: the farm waits, nothing that has come is lost.
    pub async fn stall(&mut self, why: QueueError) {
        let is_new = self.stalled.is_none();
        if is_new {
            tracing::warn!("the queue waits: {why}");
        }
        self.stalled = Some(why);
        if is_new {
            self.sync_all().await;
        }
    }

    async fn sync_all(&mut self) {
        let present: Vec<_> = self.by_shot.keys().copied().collect();
        for shot in present {
            self.sync_pause(shot).await;
        }
        self.changed.extend(self.book.iter().map(|(id, _)| id));
        self.publish();
    }

    /// Looks whether what was in the way is gone.
    pub async fn try_again(&mut self) {
        let refused = self.book.iter().filter(|(_, shot)| shot.refused.is_some());
        for shot in refused.map(|(id, _)| id).collect::<Vec<_>>() {
            self.book.set_refused(shot, None);
        }
        for (shot, hash) in self.book.all_lacking() {
            if self.is_here(hash).await {
                self.book.set_lacks(shot, None);
                self.sync_pause(shot).await;
                self.changed.insert(shot);
            }
        }
        if self.stalled.is_none() {
            return self.unstick().await;
        }
        let needed: usize =
            self.unwritten.iter().map(|picture| picture.pixels.pixels().len()).sum();
        let config = &self.shared.config;
        if let Err(why) = disk::has_room(&config.folder, config.reserve_bytes, needed as u64) {
            self.stalled = Some(why);
            return;
        }
        self.stalled = None;
        self.record().await;
        if self.stalled.is_some() {
            return;
        }
        for doubted in std::mem::take(&mut self.doubts) {
            self.doubt(doubted).await;
        }
        self.write_waiting(None);
        // Those whose end could not be written.
        self.check_all().await;
        if self.stalled.is_none() {
            tracing::info!("the queue goes on");
            self.sync_all().await;
        }
    }

    /// Forgets the oldest shots that are over, and terrain that nobody needs any more.
    async fn close(&mut self) {
        self.swept = None;
        let surplus = self.book.surplus(OVER_MAX);
        if surplus.is_empty() {
            return;
        }
        let shots = surplus.clone();
        if let Err(why) = self.ledger(move |ledger| ledger.forget(&shots)).await {
            tracing::warn!("old shots cannot be forgotten: {why}");
            return;
        }
        for shot in surplus {
            self.book.forget(shot);
            self.changed.insert(shot);
        }
    }

    /// Looks through terrain and keys for what is old, when it is time.
    pub fn sweep(&mut self) {
        let is_due = self.swept.is_none_or(|last| last.elapsed() >= SWEEP);
        if self.is_sweeping || !is_due {
            return;
        }
        (self.is_sweeping, self.swept) = (true, Some(Instant::now()));
        let (shared, tell, terrain) = (self.shared.clone(), self.tell.clone(), self.book.terrain());
        self.errands.spawn(async move {
            let swept = blocking(move || {
                let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
                let before = now.saturating_sub(KEY_KEPT).as_secs();
                shared.with_ledger(|ledger| ledger.forget_keys(before))?;
                shared.blobs.sweep(&terrain)
            });
            let swept = swept.await;
            let _ = tell.send(News::Swept(swept)).await;
        });
    }
}
