//! Office hours as people write them. What is read says for every minute whether it is a
//! working one, and when that changes.

#![no_main]

use terrafarm_worker::office::hours::{Hours, WeekMinute};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    ["mon-fri 18:00-08:00, sat, sun", "22:00-06:00", "sun-tue", "wed 0:00-24:00"]
        .map(|text| text.as_bytes().to_vec())
        .to_vec()
}

fn accepts(input: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(input) else { return false };
    let Ok(hours) = text.parse::<Hours>() else { return false };
    let minute = |of_week: u32| WeekMinute::new(of_week / 1440, of_week / 60 % 24, of_week % 60);
    for of_week in (0..10_080).step_by(487) {
        let now = hours.contains(minute(of_week));
        if let Some(until) = hours.until_change(minute(of_week)) {
            let then = (of_week + until) % 10_080;
            assert_ne!(hours.contains(minute(then)), now, "{until} minutes after {of_week}");
            assert_eq!(hours.contains(minute((then + 10_079) % 10_080)), now);
        }
    }
    true
}
