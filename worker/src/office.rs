//! A worker on somebody's PC: when it works, and with how many threads.
//!
//! [`Office`] decides, purely, from what the [`senses`] say: outside its hours a worker
//! leaves; while the PC's user is there it renders on one thread; while other programs
//! want cores it leaves those to them. Threads are taken away at once and given back one
//! after the other, when it has been quiet for a while. A job is never killed: the threads
//! that are left finish it.

pub mod hours;
pub mod senses;

use hours::{Hours, WeekMinute};
use senses::Senses;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// How long the user has to be away before threads come back.
const AWAY: Duration = Duration::from_secs(120);
/// How long cores have to be free before a thread more is used.
const CALM: Duration = Duration::from_secs(3);
/// Less than this of a core that others use is noise: the desktop's clock, an indexer.
const NOISE_CORES: f64 = 0.3;

/// What the owner of the PC wants.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rules {
    /// When to work; always, if `None`.
    pub hours: Option<Hours>,
    /// Whether to make room for the user and for other programs.
    pub polite: bool,
}

/// What is known of the PC at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// The wall clock.
    pub at: WeekMinute,
    /// Time since the user touched keyboard, mouse or a terminal; `None` if nobody can tell.
    pub untouched: Option<Duration>,
    /// Cores that other programs kept busy since the last observation; `None` if nobody
    /// can tell.
    pub others_cores: Option<f64>,
}

/// What a worker may do now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Allowance {
    /// Whether it works at all.
    pub on_duty: bool,
    /// Threads that may render, at least 1.
    pub threads: usize,
}

/// Decides what a worker may do.
#[derive(Debug)]
pub struct Office {
    rules: Rules,
    /// Threads of the worker.
    threads: usize,
    /// Threads allowed.
    allowed: usize,
    /// For how long more could have been allowed.
    calm: Duration,
}

impl Office {
    /// An office of a worker with so many threads.
    pub fn new(rules: Rules, threads: usize) -> Self {
        let threads = threads.max(1);
        Office { rules, threads, allowed: threads, calm: Duration::ZERO }
    }

    /// Whether there is nothing to look for.
    pub fn is_always_open(&self) -> bool {
        self.rules == Rules::default()
    }

    /// What the worker may do, `elapsed` after the last observation.
    pub fn observe(&mut self, seen: Observation, elapsed: Duration) -> Allowance {
        let on_duty = self.rules.hours.as_ref().is_none_or(|hours| hours.contains(seen.at));
        if self.rules.polite {
            let fit = self.fit(seen);
            if fit <= self.allowed {
                self.allowed = fit;
                self.calm = Duration::ZERO;
            } else {
                self.calm += elapsed;
                if self.calm >= CALM {
                    self.allowed += 1;
                    self.calm = Duration::ZERO;
                }
            }
        }
        Allowance { on_duty, threads: self.allowed }
    }

    /// Threads that disturb nobody.
    fn fit(&self, seen: Observation) -> usize {
        if seen.untouched.is_some_and(|untouched| untouched < AWAY) {
            return 1;
        }
        let others = seen.others_cores.unwrap_or(0.0);
        let taken = if others < NOISE_CORES { 0 } else { others.ceil().min(1e6) as usize };
        self.threads.saturating_sub(taken).max(1)
    }
}

/// How many threads may render at once, for the threads themselves to look at.
#[derive(Debug, Clone)]
pub struct Gate(Arc<AtomicUsize>);

impl Gate {
    /// Lets so many pass, at least one.
    pub fn new(threads: usize) -> Self {
        Gate(Arc::new(AtomicUsize::new(threads.max(1))))
    }

    /// Lets so many pass from now on, at least one.
    pub fn set(&self, threads: usize) {
        self.0.store(threads.max(1), Ordering::Relaxed);
    }

    /// How many may work now, at least one.
    pub fn threads(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

/// How often the PC is looked at.
const LOOK: Duration = Duration::from_millis(200);

/// Looks at the PC in a thread of its own, and says what follows: threads through the gate,
/// hours through [`Watch::on_duty`]. Ends when dropped.
#[derive(Debug)]
pub struct Watch {
    duty: watch::Receiver<bool>,
}

impl Watch {
    /// Begins to look. Where the rules ask for nothing there is nothing to look for: the
    /// worker is on duty, with all of its threads.
    pub fn begin(rules: &Rules, threads: usize, gate: &Gate) -> Watch {
        let mut office = Office::new(rules.clone(), threads);
        let (told, duty) = watch::channel(true);
        if office.is_always_open() {
            return Watch { duty };
        }
        let mut senses = Senses::new();
        // What is so at the start is known before the worker greets anyone.
        let mut look = {
            let gate = gate.clone();
            move |elapsed| {
                let allowed = office.observe(senses.observe(), elapsed);
                if gate.threads() != allowed.threads {
                    tracing::info!(
                        threads = allowed.threads,
                        of = threads,
                        "making room on this PC"
                    );
                }
                gate.set(allowed.threads);
                allowed.on_duty
            }
        };
        told.send_replace(look(Duration::ZERO));
        let looking = std::thread::Builder::new().name("office".into()).spawn(move || {
            let mut before = Instant::now();
            while !told.is_closed() {
                // No system tells when its user or another program wants the cores.
                std::thread::sleep(LOOK);
                let now = Instant::now();
                let on_duty = look(now.duration_since(before));
                before = now;
                told.send_if_modified(|told| std::mem::replace(told, on_duty) != on_duty);
            }
        });
        if let Err(why) = looking {
            tracing::warn!("cannot watch the PC, so this worker keeps no hours: {why}");
        }
        Watch { duty }
    }

    /// Waits for the hours to begin.
    pub async fn on_duty(&mut self) {
        if !*self.duty.borrow() {
            tracing::info!("off duty: waiting for this worker's hours");
        }
        // Without anyone who looks, what was true stays true.
        let _ = self.duty.wait_for(|on_duty| *on_duty).await;
    }

    /// Works; tells the work to leave when the hours are over.
    pub async fn over<T>(&mut self, work: impl Future<Output = T>, leave: &CancellationToken) -> T {
        tokio::pin!(work);
        tokio::select! {
            done = &mut work => return done,
            Ok(_) = self.duty.wait_for(|on_duty| !on_duty) => leave.cancel(),
        }
        work.await
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    const STEP: Duration = Duration::from_millis(500);

    fn polite(threads: usize) -> Office {
        Office::new(Rules { polite: true, hours: None }, threads)
    }

    fn seen(untouched_s: Option<u64>, others_cores: f64) -> Observation {
        Observation {
            at: WeekMinute::new(0, 12, 0),
            untouched: untouched_s.map(Duration::from_secs),
            others_cores: Some(others_cores),
        }
    }

    #[test]
    fn the_user_gets_the_pc_back_at_once() {
        let mut office = polite(8);
        assert_eq!(office.observe(seen(Some(3600), 0.0), STEP).threads, 8);
        assert_eq!(office.observe(seen(Some(0), 0.0), STEP).threads, 1);
    }

    #[test]
    fn threads_come_back_one_by_one_after_the_user_has_gone() {
        let mut office = polite(3);
        office.observe(seen(Some(0), 0.0), STEP);
        let mut threads = Vec::new();
        for _ in 0..14 {
            threads.push(office.observe(seen(Some(600), 0.0), STEP).threads);
        }
        assert_eq!(threads, [1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 3, 3, 3]);
        assert_eq!(office.observe(seen(Some(1), 0.0), STEP).threads, 1);
    }

    #[test]
    fn other_programs_get_the_cores_that_they_use() {
        let mut office = polite(8);
        assert_eq!(office.observe(seen(None, 0.2), STEP).threads, 8);
        assert_eq!(office.observe(seen(None, 2.4), STEP).threads, 5);
        assert_eq!(office.observe(seen(None, 64.0), STEP).threads, 1);
        assert_eq!(office.observe(seen(None, f64::INFINITY), STEP).threads, 1);
    }

    #[test]
    fn a_worker_that_need_not_be_polite_is_not() {
        let mut office = Office::new(Rules::default(), 4);
        assert!(office.is_always_open());
        let allowed = office.observe(seen(Some(0), 3.0), STEP);
        assert_eq!(allowed, Allowance { on_duty: true, threads: 4 });
    }

    #[test]
    fn outside_its_hours_a_worker_is_off_duty() {
        let hours = Some("mon 18:00-20:00".parse().unwrap());
        let mut office = Office::new(Rules { hours, polite: false }, 4);
        assert!(!office.observe(seen(None, 0.0), STEP).on_duty);
        let at = WeekMinute::new(0, 18, 30);
        assert!(office.observe(Observation { at, ..seen(None, 0.0) }, STEP).on_duty);
    }

    #[test]
    fn a_gate_always_lets_one_pass() {
        let gate = Gate::new(4);
        assert_eq!(gate.threads(), 4);
        gate.set(0);
        assert_eq!(gate.threads(), 1);
    }

    #[tokio::test]
    async fn work_is_told_to_leave_when_the_hours_end_and_is_waited_for() {
        let (told, duty) = watch::channel(true);
        let mut watch = Watch { duty };
        let leave = CancellationToken::new();
        let work = async {
            told.send_replace(false);
            leave.cancelled().await;
            "the job was finished"
        };
        assert_eq!(watch.over(work, &leave).await, "the job was finished");
        told.send_replace(true);
        watch.on_duty().await;
    }

    #[tokio::test]
    async fn work_that_ends_by_itself_is_not_told_to_leave() {
        let (_told, duty) = watch::channel(true);
        let leave = CancellationToken::new();
        assert_eq!(Watch { duty }.over(async { 7 }, &leave).await, 7);
        assert!(!leave.is_cancelled());
    }
}
