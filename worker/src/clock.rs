//! Where the time of a worker goes: a clock for its session, and one for its threads.

use crate::session::Doing;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use terrafarm_wire::message::Timesheet;

/// Adds up what a session does between two results.
#[derive(Debug)]
pub(crate) struct TaskClock {
    doing: Doing,
    since: Instant,
    idle: Duration,
    waiting: Duration,
    rendering: Duration,
    sending: Duration,
    redo: Duration,
}

/// What the thread pool says of a job.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Worked {
    /// Rendering, wall time.
    pub render: Duration,
    /// How much of it the threads had no core, on average.
    pub coreless: Duration,
    /// Packing its pixels.
    pub pack: Duration,
}

impl TaskClock {
    /// A clock that has counted nothing, of a session that has no job.
    pub fn new(now: Instant) -> Self {
        let none = Duration::ZERO;
        TaskClock {
            doing: Doing::Idle,
            since: now,
            idle: none,
            waiting: none,
            rendering: none,
            sending: none,
            redo: none,
        }
    }

    /// From now on the session does this.
    pub fn turn(&mut self, doing: Doing, now: Instant) {
        let passed = now.duration_since(self.since);
        match self.doing {
            Doing::Idle => self.idle += passed,
            Doing::Waiting => self.waiting += passed,
            Doing::Rendering => self.rendering += passed,
            Doing::Sending => self.sending += passed,
        }
        (self.doing, self.since) = (doing, now);
    }

    /// What was rendered since the last result is of no use.
    pub fn discard(&mut self, now: Instant) {
        self.turn(self.doing, now);
        self.redo += std::mem::take(&mut self.rendering);
    }

    /// The sheet of a job that is done, of which the pool says this. `unpack` is the time
    /// for reading and unpacking terrain. The clock begins anew.
    pub fn tear_off(&mut self, worked: Worked, unpack: Duration, now: Instant) -> Timesheet {
        self.turn(self.doing, now);
        let unpack = unpack.min(self.waiting);
        // Each part is at most what is left of the whole.
        let render = worked.render.min(self.rendering);
        let coreless = worked.coreless.min(render);
        let pack = worked.pack.min(self.rendering - render);
        let us = |time: Duration| time.as_micros() as u64;
        let sheet = Timesheet {
            idle_us: us(self.idle),
            terrain_us: us(self.waiting - unpack),
            unpack_us: us(unpack),
            render_us: us(render - coreless),
            coreless_us: us(coreless),
            pack_us: us(pack),
            send_us: us(self.sending),
            redo_us: us(self.redo),
            other_us: us(self.rendering - render - pack),
        };
        *self = TaskClock { doing: self.doing, ..TaskClock::new(now) };
        sheet
    }
}

/// Counts, from its start until it is dropped, how long this thread had no core.
pub(crate) struct CoreClock<'a> {
    into_ns: &'a AtomicU64,
    wall: Instant,
    core: Option<Duration>,
}

impl<'a> CoreClock<'a> {
    /// Adds to `into_ns`, nanoseconds, in the end.
    pub fn start(into_ns: &'a AtomicU64) -> Self {
        CoreClock { into_ns, wall: Instant::now(), core: thread_core_time() }
    }
}

impl Drop for CoreClock<'_> {
    fn drop(&mut self) {
        let (Some(began), Some(ended)) = (self.core, thread_core_time()) else { return };
        let coreless = self.wall.elapsed().saturating_sub(ended.saturating_sub(began));
        self.into_ns.fetch_add(coreless.as_nanos() as u64, Ordering::Relaxed);
    }
}

/// Time that this thread has had on a core, where the system tells.
#[cfg(unix)]
fn thread_core_time() -> Option<Duration> {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Some(Duration::new(time.tv_sec.try_into().ok()?, time.tv_nsec.try_into().ok()?))
}

#[cfg(not(unix))]
fn thread_core_time() -> Option<Duration> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_doing() -> impl Strategy<Value = Doing> {
        prop::sample::select(vec![Doing::Idle, Doing::Waiting, Doing::Rendering, Doing::Sending])
    }

    proptest! {
        #[test]
        fn a_sheet_adds_up_to_the_time_that_has_passed(
            turns in prop::collection::vec((any_doing(), 0u64..5000, any::<bool>()), 0..20),
            [render, coreless, pack, unpack] in prop::array::uniform4(0u64..9000),
        ) {
            let start = Instant::now();
            let mut clock = TaskClock::new(start);
            let mut now = start;
            for &(doing, passed_us, discard) in &turns {
                now += Duration::from_micros(passed_us);
                clock.turn(doing, now);
                if discard {
                    clock.discard(now);
                }
            }
            let us = Duration::from_micros;
            let worked = Worked { render: us(render), coreless: us(coreless), pack: us(pack) };
            let sheet = clock.tear_off(worked, us(unpack), now);
            prop_assert_eq!(u128::from(sheet.total_us()), (now - start).as_micros());
            prop_assert_eq!(clock.tear_off(worked, us(unpack), now).total_us(), 0);
        }
    }

    #[test]
    fn what_was_discarded_is_no_rendering() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut clock = TaskClock::new(start);
        clock.turn(Doing::Rendering, at(1));
        clock.discard(at(4));
        clock.turn(Doing::Rendering, at(4));
        let worked = Worked { render: Duration::from_millis(2), ..Worked::default() };
        let sheet = clock.tear_off(worked, Duration::ZERO, at(7));
        assert_eq!((sheet.idle_us, sheet.redo_us), (1000, 3000));
        assert_eq!((sheet.render_us, sheet.other_us), (2000, 1000));
    }

    #[test]
    fn a_thread_that_sleeps_has_no_core() {
        let coreless_ns = AtomicU64::new(0);
        let clock = CoreClock::start(&coreless_ns);
        // The pause is what is measured.
        std::thread::park_timeout(Duration::from_millis(5));
        drop(clock);
        assert!(cfg!(not(unix)) || coreless_ns.into_inner() > 0);
    }
}
