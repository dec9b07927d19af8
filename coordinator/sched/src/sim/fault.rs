//! What goes wrong in a run.

use crate::rng::Rng;

/// What hangs on one switch, share of the workers.
pub(crate) const SWITCH_SHARE: f64 = 0.2;
/// How long a switch carries nothing, shortest and longest, microseconds.
pub(crate) const SWITCH_CUT_US: (u64, u64) = (1_000_000, 30_000_000);

/// How much goes wrong. Shares are of the workers, each hit at a random moment in
/// `within_s`; the first worker is spared by all that would end its work for good.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Faults {
    /// The time in which faults happen, virtual seconds.
    pub within_s: f64,
    /// Machines that are switched on at a random moment instead of the beginning.
    pub late: f64,
    /// Programs that end; the coordinator sees the connection close.
    pub crashes: f64,
    /// Machines that lose power; the coordinator sees nothing.
    pub power_cuts: f64,
    /// Links that carry nothing for up to 20 s and then everything that was held back:
    /// the workers behind them become zombies.
    pub partitions: f64,
    /// Workers that hang for up to 30 s: the machine answers, the program does not.
    pub hangs: f64,
    /// Workers that render nothing any more but answer every probe.
    pub stuck: f64,
    /// Workers that leave in good order.
    pub drains: f64,
    /// Workers that hand their jobs back once and stay.
    pub hand_backs: f64,
    /// Workers that fail at every job.
    pub unfit: f64,
    /// Workers with a link that is 20 times (wireless) or 200 times (from home) narrower
    /// than the others', and longer.
    pub slow_links: f64,
    /// How often a switch carries nothing for 1 to 30 s and then everything that was held
    /// back; each time a fifth of the workers, neighbours, is behind it.
    pub switch_cuts: u32,
    /// How long a worker stays each time, seconds, on average; 0 for ever. It leaves in
    /// good order, crashes or loses power, one as often as the other, all through the run.
    pub stay_s: f64,
    /// Whether machines that crashed, left or lost power come back after up to 10 s.
    pub come_back: bool,
    /// Share of messages that are lost. TCP loses none; the scheduler does not rely on it.
    pub loss: f64,
    /// Share of messages that arrive twice.
    pub duplicates: f64,
    /// Share of jobs that fail anywhere.
    pub failures: f64,
}

impl Faults {
    /// A random mixture of everything, some of it usually absent. `deadly` is whether
    /// frames may fail: with workers that fail at jobs.
    pub fn random(seed: u64, within_s: f64, deadly: bool) -> Self {
        let mut rng = Rng::new(seed ^ 0xfa17);
        let mut share = |most: f64| if rng.below(2) == 0 { 0.0 } else { rng.unit() * most };
        Faults {
            within_s,
            late: share(0.8),
            crashes: share(0.8),
            power_cuts: share(0.8),
            partitions: share(0.8),
            hangs: share(0.8),
            stuck: share(0.5),
            drains: share(0.8),
            hand_backs: share(0.8),
            unfit: if deadly { share(0.5) } else { 0.0 },
            slow_links: share(0.5),
            come_back: share(1.0) > 0.0,
            loss: share(0.05),
            duplicates: share(0.1),
            failures: if deadly { share(0.05) } else { 0.0 },
            switch_cuts: (share(4.0)) as u32,
            stay_s: share(30.0),
        }
    }

    /// Everything at once, and little enough of each that the farm still gets on.
    pub fn every(within_s: f64) -> Self {
        Faults {
            within_s,
            late: 0.2,
            crashes: 0.1,
            power_cuts: 0.1,
            partitions: 0.2,
            hangs: 0.1,
            stuck: 0.03,
            drains: 0.1,
            hand_backs: 0.1,
            unfit: 0.03,
            slow_links: 0.3,
            switch_cuts: 3,
            stay_s: 40.0,
            come_back: true,
            loss: 0.002,
            duplicates: 0.005,
            failures: 0.001,
        }
    }
}

/// One thing that goes wrong with one machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    Crash,
    PowerCut,
    /// For so many microseconds.
    Partition(u64),
    /// For so many microseconds.
    Hang(u64),
    Stuck,
    Drain,
    HandBack,
}

/// The faults of one machine with their times, microseconds.
pub(crate) fn plan(faults: &Faults, is_spared: bool, rng: &mut Rng) -> Vec<(u64, Fault)> {
    let mut planned = Vec::new();
    let mut draw = |share: f64, is_final: bool, fault: &dyn Fn(&mut Rng) -> Fault| {
        let at = (rng.unit() * faults.within_s * 1e6) as u64;
        let fault = fault(rng);
        if rng.unit() < share && !(is_spared && is_final) {
            planned.push((at, fault));
        }
    };
    draw(faults.crashes, true, &|_| Fault::Crash);
    draw(faults.power_cuts, true, &|_| Fault::PowerCut);
    draw(faults.partitions, false, &|rng| Fault::Partition(rng.below(20_000_000)));
    draw(faults.hangs, false, &|rng| Fault::Hang(rng.below(30_000_000)));
    draw(faults.stuck, true, &|_| Fault::Stuck);
    draw(faults.drains, true, &|_| Fault::Drain);
    draw(faults.hand_backs, false, &|_| Fault::HandBack);
    planned
}
