//! Office hours: when in the week a worker works.
//!
//! Written as people write them: `mon-fri 18:00-08:00, sat, sun`. An entry has days, a
//! span of the clock, or both; a span that ends before it begins goes on into the next
//! day. Times are those of the PC's wall clock, so a night with a change of the clocks is
//! an hour longer or shorter.

use std::fmt;
use std::str::FromStr;

const DAY_MIN: usize = 24 * 60;
const WEEK_MIN: usize = 7 * DAY_MIN;
const DAYS: [&str; 7] = ["mon", "tue", "wed", "thu", "fri", "sat", "sun"];
/// More entries than anyone needs.
const ENTRIES_MAX: usize = 64;

/// The minutes of the week in which a worker works.
#[derive(Clone, PartialEq, Eq)]
pub struct Hours {
    /// One flag a minute, from Monday 00:00.
    works: Vec<bool>,
}

/// A minute of the week, counted from Monday 00:00; below 10 080.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WeekMinute(usize);

impl WeekMinute {
    /// Days since Monday, hour and minute of the day; larger ones wrap.
    pub fn new(day: u32, hour: u32, minute: u32) -> Self {
        let minutes = day as usize % 7 * DAY_MIN + hour as usize % 24 * 60 + minute as usize % 60;
        WeekMinute(minutes)
    }
}

/// Why hours could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "\"{entry}\" is no office hour: {why}; write days, times or both, such as \
     \"mon-fri 18:00-08:00, sat, sun\""
)]
pub struct HoursError {
    entry: String,
    why: &'static str,
}

impl Hours {
    /// Whether the worker works in this minute.
    pub fn contains(&self, at: WeekMinute) -> bool {
        self.works[at.0]
    }

    /// Minutes until it begins or ends work; `None` if it never does.
    pub fn until_change(&self, at: WeekMinute) -> Option<u32> {
        let now = self.contains(at);
        let ahead = (1..WEEK_MIN).find(|step| self.works[(at.0 + step) % WEEK_MIN] != now);
        ahead.map(|step| step as u32)
    }
}

impl fmt::Debug for Hours {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let minutes = self.works.iter().filter(|&&works| works).count();
        write!(f, "Hours({minutes} of {WEEK_MIN} minutes)")
    }
}

impl FromStr for Hours {
    type Err = HoursError;

    fn from_str(text: &str) -> Result<Self, HoursError> {
        let mut works = vec![false; WEEK_MIN];
        for (number, entry) in text.split(',').enumerate() {
            let entry = entry.trim();
            let fail = |why| HoursError { entry: entry.chars().take(40).collect(), why };
            if number >= ENTRIES_MAX {
                return Err(fail("there are more entries than a week can need"));
            }
            let (days, span) = read_entry(entry).map_err(fail)?;
            for day in days {
                let (begin, end) = span.unwrap_or((0, DAY_MIN));
                let length = if end > begin { end - begin } else { end + DAY_MIN - begin };
                for minute in 0..length {
                    works[(day * DAY_MIN + begin + minute) % WEEK_MIN] = true;
                }
            }
        }
        Ok(Hours { works })
    }
}

type Entry = (Vec<usize>, Option<(usize, usize)>);

fn read_entry(entry: &str) -> Result<Entry, &'static str> {
    let words: Vec<&str> = entry.split_whitespace().collect();
    match words[..] {
        [] => Err("it is empty"),
        [only] if only.contains(':') => Ok(((0..7).collect(), Some(read_span(only)?))),
        [days] => Ok((read_days(days)?, None)),
        [days, span] => Ok((read_days(days)?, Some(read_span(span)?))),
        _ => Err("it has more than days and a span of time; separate entries by commas"),
    }
}

/// `mon`, `mon-fri`, `sat-mon`, `daily`.
fn read_days(text: &str) -> Result<Vec<usize>, &'static str> {
    let text = text.to_ascii_lowercase();
    if text == "daily" {
        return Ok((0..7).collect());
    }
    let day = |name: &str| {
        let known = DAYS.iter().position(|known| name.len() >= 3 && name.starts_with(known));
        known.ok_or("a day is mon, tue, wed, thu, fri, sat or sun")
    };
    let Some((first, last)) = text.split_once('-') else { return Ok(vec![day(&text)?]) };
    let (first, last) = (day(first)?, day(last)?);
    Ok((0..=(last + 7 - first) % 7).map(|step| (first + step) % 7).collect())
}

/// `18:00-08:00`; 24:00 is the end of a day.
fn read_span(text: &str) -> Result<(usize, usize), &'static str> {
    let clock = |text: &str| {
        let (hour, minute) = text.split_once(':')?;
        let digits = |part: &str| part.len() == 2 && part.bytes().all(|b| b.is_ascii_digit());
        if !(digits(hour) || hour.len() == 1) || !digits(minute) {
            return None;
        }
        let (hour, minute): (usize, usize) = (hour.parse().ok()?, minute.parse().ok()?);
        (minute < 60 && hour * 60 + minute <= DAY_MIN).then_some(hour * 60 + minute)
    };
    let (begin, end) = text.split_once('-').ok_or("a span of time is two times, 18:00-08:00")?;
    let (begin, end) = (clock(begin), clock(end));
    let (Some(begin), Some(end)) = (begin, end) else { return Err("a time is 0:00 to 24:00") };
    if begin == end || begin == DAY_MIN {
        return Err("the span is empty");
    }
    Ok((begin, end))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use proptest::prelude::*;

    fn at(day: &str, clock: &str) -> WeekMinute {
        let (hour, minute) = clock.split_once(':').unwrap();
        let day = DAYS.iter().position(|known| *known == day).unwrap();
        WeekMinute::new(day as u32, hour.parse().unwrap(), minute.parse().unwrap())
    }

    #[test]
    fn nights_and_weekends_are_read_as_written() {
        let hours: Hours = "mon-fri 18:00-08:00, sat, Sunday".parse().unwrap();
        for (day, clock, works) in [
            ("mon", "7:59", false),
            ("mon", "17:59", false),
            ("mon", "18:00", true),
            ("tue", "07:59", true),
            ("tue", "08:00", false),
            ("fri", "23:59", true),
            ("sat", "00:00", true),
            ("sun", "23:59", true),
            ("mon", "00:00", false),
        ] {
            assert_eq!(hours.contains(at(day, clock)), works, "{day} {clock}");
        }
    }

    #[test]
    fn a_span_without_days_holds_daily_and_wraps_over_the_week() {
        let hours: Hours = "22:00-6:00".parse().unwrap();
        assert!(hours.contains(at("mon", "05:59")) && hours.contains(at("sun", "23:00")));
        assert!(!hours.contains(at("mon", "06:00")));
        let late: Hours = "sun 20:00-24:00".parse().unwrap();
        assert!(late.contains(at("sun", "23:59")) && !late.contains(at("mon", "0:00")));
        let around: Hours = "sat-mon".parse().unwrap();
        assert!(around.contains(at("sun", "1:00")) && !around.contains(at("tue", "1:00")));
    }

    #[test]
    fn the_next_change_is_counted_in_minutes() {
        let hours: Hours = "mon-fri 18:00-08:00, sat, sun".parse().unwrap();
        assert_eq!(hours.until_change(at("mon", "17:00")), Some(60));
        assert_eq!(hours.until_change(at("fri", "18:00")), Some((6 + 48) * 60));
        assert_eq!("daily".parse::<Hours>().unwrap().until_change(at("mon", "0:00")), None);
    }

    #[test]
    fn what_is_no_hour_is_refused_with_an_example() {
        for text in [
            "",
            "monday-",
            "mon 18:00",
            "25:00-1:00",
            "mon 1:60-2:00",
            "8:00-8:00",
            "funday",
            "mon x y",
        ] {
            let why = text.parse::<Hours>().unwrap_err().to_string();
            assert!(why.contains("such as"), "{text}: {why}");
        }
        assert!("mon,".repeat(1000).parse::<Hours>().is_err());
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "\\PC{0,60}") {
            let _ = text.parse::<Hours>();
        }

        #[test]
        fn a_change_is_where_work_begins_or_ends(
            day in 0u32..7, begin in 0usize..1440, length in 1usize..1440, now in 0usize..10_080,
        ) {
            let clock = |minutes: usize| format!("{:02}:{:02}", minutes / 60 % 24, minutes % 60);
            let text = format!("{} {}-{}", DAYS[day as usize], clock(begin), clock(begin + length));
            let hours: Hours = text.parse().unwrap();
            let now = WeekMinute(now);
            let step = hours.until_change(now).unwrap() as usize;
            let then = |step: usize| hours.contains(WeekMinute((now.0 + step) % 10_080));
            prop_assert!((0..step).all(|step| then(step) == then(0)));
            prop_assert!(then(step) != then(0));
        }
    }
}
