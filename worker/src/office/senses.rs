//! What a worker can tell of the PC that it runs on.
//!
//! On Linux: terminals and the keyboard's interrupts say when the user was there, and the
//! session keeper (logind), where there is one, whether a desktop is in use; `/proc/stat`
//! less the own time says what others compute. On Windows: the time of the last input. What
//! cannot be told is `None`, and nobody is polite about it.

use super::Observation;
use super::hours::WeekMinute;
use std::time::Duration;
#[cfg(target_os = "linux")]
use std::time::Instant;

/// How often the session keeper is asked: it is a process of its own.
#[cfg(target_os = "linux")]
const ASK_EVERY: Duration = Duration::from_secs(2);

/// The senses, and what they remember.
#[derive(Debug, Default)]
pub struct Senses {
    #[cfg(target_os = "linux")]
    linux: linux::Memory,
}

impl Senses {
    /// Senses without a memory.
    pub fn new() -> Self {
        Senses::default()
    }

    /// What is so now. Reads a few small files and, every two seconds, asks a program.
    pub fn observe(&mut self) -> Observation {
        let (untouched, others_cores) = self.of_system();
        Observation { at: minute_of(&jiff::Zoned::now()), untouched, others_cores }
    }

    #[cfg(target_os = "linux")]
    fn of_system(&mut self) -> (Option<Duration>, Option<f64>) {
        let now = Instant::now();
        (self.linux.untouched(now), self.linux.others_cores(now))
    }

    #[cfg(windows)]
    fn of_system(&mut self) -> (Option<Duration>, Option<f64>) {
        (windows::untouched(), None)
    }

    #[cfg(not(any(target_os = "linux", windows)))]
    fn of_system(&mut self) -> (Option<Duration>, Option<f64>) {
        (None, None)
    }
}

/// The minute of the week at a time, by the clock of its zone.
fn minute_of(now: &jiff::Zoned) -> WeekMinute {
    let day = now.weekday().to_monday_zero_offset();
    WeekMinute::new(
        day.unsigned_abs().into(),
        now.hour().unsigned_abs().into(),
        now.minute().unsigned_abs().into(),
    )
}

#[cfg(target_os = "linux")]
mod linux {
    use super::{ASK_EVERY, Duration, Instant};
    use std::fs;
    use std::os::unix::fs::MetadataExt;
    use std::path::Path;
    use std::process::{Command, Stdio};
    use std::time::{SystemTime, UNIX_EPOCH};

    #[derive(Debug, Default)]
    pub struct Memory {
        /// Interrupts of keyboard and mouse so far.
        interrupts: Option<u64>,
        /// When they last became more.
        interrupted: Option<Instant>,
        /// When the session keeper was last asked, and whether a session is in use.
        asked: Option<(Instant, Option<bool>)>,
        /// Time of all cores and of this process, ticks, and when that was.
        times: Option<(u64, u64, Instant)>,
    }

    impl Memory {
        /// Time since the user was last there.
        pub fn untouched(&mut self, now: Instant) -> Option<Duration> {
            if let Ok(text) = fs::read_to_string("/proc/interrupts")
                && let Some(count) = input_interrupts(&text)
                && self.interrupts.replace(count).is_some_and(|before| before != count)
            {
                self.interrupted = Some(now);
            }
            if self.asked.is_none_or(|(at, _)| now.duration_since(at) >= ASK_EVERY) {
                self.asked = Some((now, session_in_use()));
            }
            let by_hand = self.interrupted.map(|at| now.duration_since(at));
            // Known only as "not now" before the first key: as long as this worker looks.
            let in_session = match self.asked {
                Some((_, Some(true))) => Some(Duration::ZERO),
                _ => None,
            };
            [by_hand, in_session, terminal_untouched()].into_iter().flatten().min()
        }

        /// Cores that others kept busy since the last call.
        pub fn others_cores(&mut self, now: Instant) -> Option<f64> {
            let all = busy_ticks(&fs::read_to_string("/proc/stat").ok()?)?;
            let own = own_ticks(&fs::read_to_string("/proc/self/stat").ok()?)?;
            let (all_before, own_before, then) = self.times.replace((all, own, now))?;
            let seconds = now.duration_since(then).as_secs_f64();
            if seconds <= 0.0 {
                return None;
            }
            let per_second = rustix::param::clock_ticks_per_second() as f64;
            let ticks = ticks_of_others([all_before, all], [own_before, own]);
            Some(ticks as f64 / per_second / seconds)
        }
    }

    /// Of the ticks of all processes, before and after, those that were not our own.
    fn ticks_of_others(all: [u64; 2], own: [u64; 2]) -> u64 {
        let since = |[before, after]: [u64; 2]| after.saturating_sub(before);
        // The two are read one after the other, so that our own may seem to be more than all.
        since(all).saturating_sub(since(own))
    }

    /// Interrupts of the keyboard controller; `None` where there is none.
    fn input_interrupts(text: &str) -> Option<u64> {
        let lines = text.lines().filter(|line| line.contains("i8042"));
        let counts = lines.map(|line| {
            let numbers =
                line.split_whitespace().skip(1).map_while(|word| word.parse::<u64>().ok());
            numbers.fold(0, u64::wrapping_add)
        });
        counts.reduce(u64::wrapping_add)
    }

    /// Time since someone typed into a terminal, of this PC or from afar.
    fn terminal_untouched() -> Option<Duration> {
        let pseudo =
            fs::read_dir("/dev/pts").into_iter().flatten().flatten().map(|entry| entry.path());
        let consoles = (1..=12).map(|number| format!("/dev/tty{number}").into());
        let read = pseudo.filter(|path| path.file_name() != Some("ptmx".as_ref())).chain(consoles);
        let newest = read.filter_map(|path| read_at(&path)).max()?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).ok()?.as_secs();
        Some(Duration::from_secs(now.saturating_sub(newest)))
    }

    /// When a terminal that somebody owns was last read from, seconds since 1970.
    fn read_at(path: &Path) -> Option<u64> {
        let facts = fs::metadata(path).ok()?;
        u64::try_from(facts.atime()).ok()
    }

    /// Whether a session is in use, by the session keeper; `None` if there is none.
    fn session_in_use() -> Option<bool> {
        let mut asking = Command::new("loginctl");
        asking.args(["show", "--property=IdleHint"]).stdin(Stdio::null()).stderr(Stdio::null());
        let answer = asking.output().ok().filter(|answer| answer.status.success())?;
        match String::from_utf8_lossy(&answer.stdout).trim() {
            "IdleHint=no" => Some(true),
            "IdleHint=yes" => Some(false),
            _ => None,
        }
    }

    /// Ticks that all cores were busy: user, nice, system and interrupts.
    fn busy_ticks(text: &str) -> Option<u64> {
        let line = text.lines().next()?.strip_prefix("cpu ")?;
        let ticks: Vec<u64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
        let [user, nice, system, _idle, _waiting, interrupts, soft, ..] = ticks[..] else {
            return None;
        };
        [user, nice, system, interrupts, soft].into_iter().try_fold(0u64, u64::checked_add)
    }

    /// Ticks that this process was on a core.
    fn own_ticks(text: &str) -> Option<u64> {
        // The name in brackets may hold anything, brackets and blanks included.
        let (_, fields) = text.rsplit_once(')')?;
        let mut fields = fields.split_whitespace().skip(11);
        let user: u64 = fields.next()?.parse().ok()?;
        let system: u64 = fields.next()?.parse().ok()?;
        user.checked_add(system)
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn interrupts_of_the_keyboard_are_added_up() {
            let text = "           CPU0       CPU1\n  1:         12         30   IO-APIC   1-edge      i8042\n \
                        9:          0          5   IO-APIC   9-fasteoi   acpi\n 12:          7          0   IO-APIC  12-edge      i8042\n";
            assert_eq!(input_interrupts(text), Some(49));
            assert_eq!(input_interrupts("CPU0\n 9: 5 acpi\n"), None);
        }

        #[test]
        fn busy_time_leaves_out_waiting_and_stolen_time() {
            assert_eq!(busy_ticks("cpu  10 20 30 4000 500 6 7 80 0 0\ncpu0 1\n"), Some(73));
            assert_eq!(busy_ticks("cpu  10 20\n"), None);
            assert_eq!(busy_ticks(""), None);
        }

        #[test]
        fn own_time_is_found_behind_any_name() {
            let text = "77 (a ) b) S 1 77 77 0 -1 4194304 1 0 0 0 250 31 0 0 20 0 9 0 1 2 3";
            assert_eq!(own_ticks(text), Some(281));
            assert_eq!(own_ticks("77 (x"), None);
        }

        #[test]
        fn this_process_is_not_one_of_the_others() {
            assert_eq!(ticks_of_others([1000, 1400], [70, 370]), 100);
            assert_eq!(ticks_of_others([1000, 1400], [70, 480]), 0);
            // Counters that were set back.
            assert_eq!(ticks_of_others([1000, 10], [70, 70]), 0);
            let mut memory = Memory::default();
            let now = Instant::now();
            assert_eq!(memory.others_cores(now), None, "nothing to compare with yet");
            assert!(memory.others_cores(now + Duration::from_secs(1)).is_some());
        }
    }
}

#[cfg(windows)]
mod windows {
    use super::Duration;
    use windows_sys::Win32::System::SystemInformation::GetTickCount;
    use windows_sys::Win32::UI::Input::KeyboardAndMouse::{GetLastInputInfo, LASTINPUTINFO};

    /// Time since the last input of the session that the worker runs in.
    #[expect(unsafe_code, reason = "the system's own function, which has no safe form")]
    pub fn untouched() -> Option<Duration> {
        let mut last = LASTINPUTINFO { cbSize: size_of::<LASTINPUTINFO>() as u32, dwTime: 0 };
        // SAFETY: `last` is a valid structure of the size that it names.
        let told = unsafe { GetLastInputInfo(&mut last) };
        // SAFETY: no argument, no condition.
        let now = unsafe { GetTickCount() };
        (told != 0).then(|| Duration::from_millis(u64::from(now.wrapping_sub(last.dwTime))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wall_clock_advances_by_whole_minutes_of_the_week() {
        let zone = jiff::tz::TimeZone::fixed(jiff::tz::offset(1));
        // A Sunday, 23:59 in a zone an hour ahead of UTC.
        let sunday = jiff::civil::date(2026, 11, 22).at(23, 59, 30, 0).to_zoned(zone);
        let sunday = sunday.expect("the time exists");
        assert_eq!(minute_of(&sunday), WeekMinute::new(6, 23, 59));
        assert_eq!(
            minute_of(&(&sunday + jiff::SignedDuration::from_secs(30))),
            WeekMinute::new(0, 0, 0)
        );
    }
}
