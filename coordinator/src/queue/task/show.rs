//! What is shown of the queue.

use super::Task;
use crate::queue::book::state_of;
use crate::queue::ledger::Stage;
use crate::view::{ShotState, ShotView};
use std::sync::Arc;
use terrafarm_common::id::ShotId;

impl Task {
    /// Publishes what has changed since the last time.
    pub fn publish(&mut self) {
        if self.changed.is_empty() {
            return;
        }
        let mut list = Vec::clone(&self.list.borrow());
        for shot in std::mem::take(&mut self.changed) {
            let at = list.binary_search_by_key(&shot, |view: &Arc<ShotView>| view.id);
            match (at, self.view(shot)) {
                (Ok(at), Some(view)) => list[at] = Arc::new(view),
                (Err(at), Some(view)) => list.insert(at, Arc::new(view)),
                (Ok(at), None) => {
                    list.remove(at);
                }
                (Err(_), None) => {}
            }
        }
        self.list.send_replace(Arc::new(list));
    }

    /// One shot as it is now.
    pub fn view(&self, id: ShotId) -> Option<ShotView> {
        let shot = self.book.get(id)?;
        let (record, plan) = (&shot.record, &shot.record.plan);
        let stay = self.by_shot.get(&id).and_then(|stay| self.stays.get(stay));
        let lately = stay.map(|stay| &stay.lately);
        let frames_per_s = lately.and_then(|times| {
            let since = times.front()?.elapsed().as_secs_f64();
            (times.len() > 1).then(|| (times.len() - 1) as f64 / since.max(1e-3))
        });
        let waits_for = self.stalled.as_ref().or(shot.stuck.as_ref());
        let (state, note) = match (record.stage, waits_for, shot.lacks, &shot.refused) {
            (Stage::Open | Stage::Finishing, Some(why), ..) => {
                (ShotState::Stalled, why.to_string())
            }
            (Stage::Open, _, Some(hash), _) => (
                ShotState::Stalled,
                format!(
                    "blob {} of its terrain is damaged or gone; submit the terrain again, and the shot \
                     goes on",
                    hash.to_hex()
                ),
            ),
            (Stage::Open, _, _, Some(why)) => (ShotState::Waiting, why.clone()),
            (Stage::Open, ..) if stay.is_some_and(|stay| stay.is_accepted) => {
                (ShotState::Running, record.note.clone())
            }
            (stage, ..) => (state_of(stage), record.note.clone()),
        };
        let left = record.frames.saturating_sub(shot.progress.over());
        let frames_per_s = frames_per_s.filter(|_| state == ShotState::Running).unwrap_or(0.0);
        Some(ShotView {
            id,
            name: plan.name.clone(),
            state,
            note,
            priority: plan.priority,
            queued: true,
            first_frame: plan.first_frame,
            frames: record.frames,
            frames_done: shot.progress.done,
            frames_failed: shot.progress.failed,
            size: plan.size,
            method: plan.quality.method.name().to_owned(),
            submitted_s: record.submitted_s,
            frames_per_s,
            eta_s: (frames_per_s > 0.0).then(|| f64::from(left) / frames_per_s),
            // Of a shot that is done, a note says why there is none.
            film: record.stage == Stage::Done && plan.film.is_some() && record.note.is_empty(),
            last_frame: shot.progress.last.map(|index| plan.first_frame + index),
            history: record.history.clone(),
        })
    }
}
