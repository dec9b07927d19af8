//! Frames that are not believed any more: a worker whose pixels are in them was found at fault.
//! They are missing again, wherever on their way they are, and the shot goes to the farm once
//! more for them.

use super::Task;
use super::stay::StayId;
use crate::queue::ledger::{FrameRecord, Stage};
use terrafarm_common::id::{FrameIndex, ShotId};

/// Frames of a shot with pixels of a worker that is not believed any more.
pub struct Doubted {
    /// The stay in which they were rendered.
    pub stay: StayId,
    /// The shot.
    pub shot: ShotId,
    /// The worker's name.
    pub worker: String,
    /// Each by its index in that stay, and in the shot.
    pub frames: Vec<(FrameIndex, FrameIndex)>,
}

impl Task {
    /// Forgets frames, so that they are rendered again.
    pub async fn doubt(&mut self, doubted: Doubted) {
        let Doubted { stay, shot, .. } = doubted;
        let Some(state) = self.book.get(shot) else { return };
        if state.record.stage.is_over() {
            return;
        }
        let before = state.progress;
        self.distrusted.extend(doubted.frames.iter().map(|(frame, _)| (shot, stay, *frame)));
        let dropped = self.drop_waiting(shot, stay).await;
        let indices: Vec<_> = doubted.frames.iter().map(|(_, index)| *index).collect();
        let progress = match self.ledger(move |ledger| ledger.unrecord(shot, &indices)).await {
            Ok(progress) => progress,
            Err(why) => {
                self.doubts.push(doubted);
                return self.stall(why).await;
            }
        };
        self.book.advance(shot, progress);
        let count = before.done.saturating_sub(progress.done) + dropped;
        tracing::warn!(%shot, worker = doubted.worker, count, "frames are rendered again");
        self.tell_of_doubt(shot, &doubted.worker, count).await;
        self.check_complete(shot).await;
    }

    /// Drops what waits to be recorded or for room on the disk and is not believed; returns
    /// how many frames.
    async fn drop_waiting(&mut self, shot: ShotId, stay: StayId) -> u32 {
        let mut dropped = Vec::new();
        let distrusted = &mut self.distrusted;
        self.outcomes.retain(|outcome| {
            let is_done = matches!(outcome.record, FrameRecord::Done { .. });
            let place = (outcome.shot, outcome.stay, outcome.frame);
            let is_kept = !is_done || !distrusted.remove(&place);
            dropped.extend((!is_kept).then_some(outcome.frame));
            is_kept
        });
        self.unwritten.retain(|picture| {
            let is_kept = !distrusted.remove(&(picture.shot(), picture.stay, picture.frame));
            dropped.extend((!is_kept).then_some(picture.frame));
            is_kept
        });
        for &frame in &dropped {
            self.drop_in_hand(shot, stay, frame).await;
        }
        dropped.len() as u32
    }

    /// A frame that has come is not kept; the farm may send the next one.
    pub async fn drop_in_hand(&mut self, shot: ShotId, stay: StayId, frame: FrameIndex) {
        self.book.count_in_hand(shot, -1);
        self.taken(stay, frame).await;
    }

    /// Notes in the shot's history that frames are rendered again. One that was about to be
    /// finished is not.
    async fn tell_of_doubt(&mut self, shot: ShotId, worker: &str, count: u32) {
        let Some(state) = self.book.get(shot) else { return };
        let mut record = state.record.clone();
        record.note = format!(
            "{count} finished frames are rendered again: {worker}, which rendered parts of them, was \
             found to be at fault"
        );
        record.happened(record.note.clone());
        if record.stage == Stage::Finishing {
            record.stage = Stage::Open;
            if let Some((_, guard)) = self.finishing.as_mut().filter(|(other, _)| *other == shot) {
                *guard = None;
            }
        }
        if let Err(why) = self.keep(shot, record).await {
            self.stall(why).await;
        }
    }
}
