//! Whom the farm believes: what audits need of pixels, and what they find.

use super::{Farm, Greeting};
use crate::shots::Doubt;
use std::collections::VecDeque;
use std::hash::{BuildHasher, Hasher, RandomState};
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};
use terrafarm_common::region::Region;
use terrafarm_sched::{Distrust, Micros, SentFrames};
use terrafarm_wire::message::Timesheet;

/// Most distrusted workers that are remembered; of more, the first ones are forgotten.
const CULPRITS_MAX: usize = 4096;

/// What the farm knows for its audits.
#[derive(Debug)]
pub(super) struct Trust {
    /// The key of the digests, drawn at each start: nobody can make pixels that seem to be
    /// others. `None` where nothing is audited.
    key: Option<RandomState>,
    /// Workers that were at fault: one that connects again is not believed for that.
    culprits: VecDeque<Greeting>,
}

impl Trust {
    /// Nobody is distrusted. Without audits, pixels need no digest.
    pub(super) fn new(is_auditing: bool) -> Self {
        Trust { key: is_auditing.then(RandomState::new), culprits: VecDeque::new() }
    }

    /// A number that equal pixels share.
    pub(super) fn digest(&self, pixels: &[u8]) -> u64 {
        self.key.as_ref().map_or(0, |key| {
            let mut hasher = key.build_hasher();
            hasher.write(pixels);
            hasher.finish()
        })
    }

    /// Whether a worker is one that was at fault.
    pub(super) fn is_distrusted(&self, worker: &Greeting) -> bool {
        self.culprits.iter().any(|culprit| is_the_same(culprit, worker))
    }

    fn distrust(&mut self, worker: Greeting) {
        if !self.is_distrusted(&worker) {
            if self.culprits.len() >= CULPRITS_MAX {
                self.culprits.pop_front();
            }
            self.culprits.push_back(worker);
        }
    }

    fn believe(&mut self, worker: &Greeting) {
        self.culprits.retain(|culprit| !is_the_same(culprit, worker));
    }
}

/// Whether two workers run on the same PC, as far as one can tell: they give the same number
/// of it, or connect from the same address by the same name. A name alone says nothing (two
/// PCs may be called alike), nor does an address (many may share one). Nothing of it is
/// proved: this is for memory that fails, not for those who lie.
fn is_the_same(one: &Greeting, other: &Greeting) -> bool {
    let same_number = one.identity != 0 && one.identity == other.identity;
    same_number || (&one.name, one.address) == (&other.name, other.address)
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

    /// Reports a worker that was at fault, and remembers it.
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
        if let Some(state) = self.workers.get(&worker) {
            self.trust.distrust(state.greeting.clone());
        }
    }

    /// An operator believes a worker again.
    pub(super) fn trust_again(&mut self, worker: WorkerId) {
        let name = self.name_of(worker);
        tracing::info!(%worker, %name, "worker is trusted again");
        if let Some(state) = self.workers.get(&worker) {
            self.trust.believe(&state.greeting);
        }
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

    fn greeting(name: &str, identity: u128, address: u8) -> Greeting {
        let address = Some(std::net::IpAddr::from([10, 0, 0, address]));
        Greeting { name: name.to_owned(), threads: 4, identity, address }
    }

    #[test]
    fn a_culprit_is_known_under_another_name_and_another_pc_of_its_name_is_none() {
        let mut trust = Trust::new(true);
        trust.distrust(greeting("render", 7, 1));
        trust.distrust(greeting("nobody", 0, 1));
        for (worker, is_known) in [
            (greeting("render", 7, 1), true),
            (greeting("renamed", 7, 1), true),
            (greeting("renamed-and-moved", 7, 2), true),
            (greeting("render", 8, 1), true),
            (greeting("render", 8, 2), false),
            (greeting("render", 0, 2), false),
            (greeting("other", 0, 1), false),
            (greeting("nobody", 0, 1), true),
            (greeting("nobody", 0, 2), false),
        ] {
            assert_eq!(trust.is_distrusted(&worker), is_known, "{worker:?}");
        }
        trust.believe(&greeting("renamed", 7, 3));
        assert!(!trust.is_distrusted(&greeting("render", 7, 1)));
        assert!(trust.is_distrusted(&greeting("nobody", 0, 1)), "only the one that was cleared");
    }

    #[test]
    fn so_many_culprits_are_remembered_and_the_first_is_forgotten() {
        let mut trust = Trust::new(true);
        (1..=CULPRITS_MAX as u128 + 1).for_each(|n| trust.distrust(greeting(&n.to_string(), n, 1)));
        assert_eq!(trust.culprits.len(), CULPRITS_MAX);
        assert!(
            !trust.is_distrusted(&greeting("a", 1, 2)) && trust.is_distrusted(&greeting("a", 2, 2))
        );
    }

    #[test]
    fn runs_of_frames_are_spoken_shortly() {
        assert_eq!(spoken(&[(3, 17), (40, 40)]), "frames 3 to 17, 40");
    }
}
