//! Whom the farm believes: what audits need of pixels, and what they find.

use super::Farm;
use crate::shots::Doubt;
use std::collections::BTreeSet;
use std::hash::{BuildHasher, Hasher, RandomState};
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};
use terrafarm_common::region::Region;
use terrafarm_sched::{Distrust, Micros, SentFrames};
use terrafarm_wire::message::Timesheet;

/// Most names of distrusted workers that are remembered; of more, some are forgotten.
const NAMES_MAX: usize = 4096;

/// What the farm knows for its audits.
#[derive(Debug)]
pub(super) struct Trust {
    /// The key of the digests, drawn at each start: nobody can make pixels that seem to be
    /// others. `None` where nothing is audited.
    key: Option<RandomState>,
    /// Workers that were at fault: one that connects again is not believed for that.
    distrusted: BTreeSet<String>,
}

impl Trust {
    /// Nobody is distrusted. Without audits, pixels need no digest.
    pub(super) fn new(is_auditing: bool) -> Self {
        Trust { key: is_auditing.then(RandomState::new), distrusted: BTreeSet::new() }
    }

    /// A number that equal pixels share.
    pub(super) fn digest(&self, pixels: &[u8]) -> u64 {
        self.key.as_ref().map_or(0, |key| {
            let mut hasher = key.build_hasher();
            hasher.write(pixels);
            hasher.finish()
        })
    }

    /// Whether a worker of this name was at fault.
    pub(super) fn is_distrusted(&self, name: &str) -> bool {
        self.distrusted.contains(name)
    }
}

impl Farm {
    /// Counts the time of an audit, and says what it found if it is not what it should.
    pub(super) fn count_audit(
        &mut self,
        now: Micros,
        worker: WorkerId,
        shot: Option<ShotId>,
        agrees: bool,
        sheet: &Timesheet,
    ) {
        if !agrees {
            tracing::warn!(%worker, "audit: renders something else than was accepted before");
        }
        self.count_waste(now, worker, shot, sheet);
    }

    /// Reports a worker that was at fault, and remembers its name.
    pub(super) fn distrust(&mut self, worker: WorkerId, why: &Distrust, sent: &[SentFrames]) {
        let name = self.name_of(worker);
        tracing::error!(
            %worker, %name,
            "audit: worker is distrusted and gets no more jobs: {why}; look at its memory and its \
             cooling, then clear it"
        );
        for SentFrames { shot, frames } in sent {
            let numbers = spoken(&self.numbered(*shot, frames));
            let doubt = Doubt { worker: name.clone(), frames: frames.clone() };
            let again = match self.shots.get(*shot).is_some_and(|state| state.doubt(doubt)) {
                true => "the queue has them rendered again",
                false => "render them again",
            };
            tracing::error!(
                %worker, %name, %shot,
                "audit: {numbers} were sent with pixels of it; {again}"
            );
        }
        if !name.is_empty() {
            if self.trust.distrusted.len() >= NAMES_MAX {
                self.trust.distrusted.pop_first();
            }
            self.trust.distrusted.insert(name);
        }
    }

    /// An operator believes a worker again.
    pub(super) fn trust_again(&mut self, worker: WorkerId) {
        let name = self.name_of(worker);
        tracing::info!(%worker, %name, "worker is trusted again");
        self.trust.distrusted.remove(&name);
    }

    /// Reports that nobody can tell who is right.
    pub(super) fn report_dispute(
        &self,
        shot: ShotId,
        frame: FrameIndex,
        region: Region,
        workers: &[WorkerId],
    ) {
        let names: Vec<_> = workers.iter().map(|&worker| self.name_of(worker)).collect();
        tracing::error!(
            %shot, frame = self.number(shot, frame), ?region,
            "audit: {} render it differently, and nobody else can tell who is right; add a worker, \
             or render the frame on each of them and compare",
            names.join(" and ")
        );
    }

    /// Runs of frames by their numbers within the flight.
    fn numbered(
        &self,
        shot: ShotId,
        runs: &[(FrameIndex, FrameIndex)],
    ) -> Vec<(FrameIndex, FrameIndex)> {
        let mut numbered: Vec<(FrameIndex, FrameIndex)> = Vec::new();
        for frame in runs.iter().flat_map(|&(first, last)| first..=last) {
            let number = self.number(shot, frame);
            match numbered.last_mut() {
                Some((_, last)) if last.checked_add(1) == Some(number) => *last = number,
                _ => numbered.push((number, number)),
            }
        }
        numbered
    }

    fn name_of(&self, worker: WorkerId) -> String {
        self.workers.get(&worker).map_or_else(String::new, |state| state.greeting.name.clone())
    }
}

/// Runs of frames in words.
fn spoken(runs: &[(FrameIndex, FrameIndex)]) -> String {
    let run = |&(first, last): &(FrameIndex, FrameIndex)| {
        if first == last { format!("{first}") } else { format!("{first} to {last}") }
    };
    let runs: Vec<String> = runs.iter().map(run).collect();
    format!("frames {}", runs.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_pixels_share_a_digest_and_others_do_not() {
        let trust = Trust::new(true);
        assert_eq!(trust.digest(&[1, 2, 3]), trust.digest(&[1, 2, 3]));
        assert_ne!(trust.digest(&[1, 2, 3]), trust.digest(&[1, 2, 4]));
        assert_ne!(trust.digest(&[1, 2, 3]), Trust::new(true).digest(&[1, 2, 3]), "keys differ");
        assert_eq!(Trust::new(false).digest(&[1, 2, 3]), 0);
    }

    #[test]
    fn runs_of_frames_are_spoken_shortly() {
        assert_eq!(spoken(&[(3, 17), (40, 40)]), "frames 3 to 17, 40");
    }
}
