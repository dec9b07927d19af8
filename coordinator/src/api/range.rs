//! The one kind of `Range` header that is answered: one range of bytes (RFC 9110, 14).

/// What of a content is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wanted {
    /// All of it.
    All,
    /// This many bytes from the first one on; at least one.
    Part {
        /// First byte.
        first: u64,
        /// Number of bytes.
        length: u64,
    },
    /// Nothing that it has.
    Nothing,
}

/// What a header asks for of so many bytes. Anything but one plain range is as good as
/// none, as the standard says.
pub(super) fn wanted(header: Option<&str>, total: u64) -> Wanted {
    let Some(spec) = header.and_then(|header| header.trim().strip_prefix("bytes=")) else {
        return Wanted::All;
    };
    let Some((from, to)) = spec.trim().split_once('-') else { return Wanted::All };
    let number = |text: &str| {
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        digits.then(|| text.parse::<u64>().unwrap_or(u64::MAX))
    };
    let (first, end) = match (number(from), number(to)) {
        (Some(first), None) if to.is_empty() => (first, total),
        (Some(first), Some(last)) if first <= last => (first, last.saturating_add(1).min(total)),
        (None, Some(suffix)) if from.is_empty() => (total.saturating_sub(suffix), total),
        _ => return Wanted::All,
    };
    match end.checked_sub(first) {
        None | Some(0) => Wanted::Nothing,
        Some(length) => Wanted::Part { first, length },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn part(first: u64, length: u64) -> Wanted {
        Wanted::Part { first, length }
    }

    #[test]
    fn ranges_are_read_as_the_standard_says() {
        for (header, expected) in [
            ("bytes=0-9", part(0, 10)),
            ("bytes=90-", part(90, 10)),
            ("bytes=-10", part(90, 10)),
            ("bytes=-1000", part(0, 100)),
            ("bytes=95-1000", part(95, 5)),
            ("bytes=0-99999999999999999999999", part(0, 100)),
            ("bytes=100-", Wanted::Nothing),
            ("bytes=-0", Wanted::Nothing),
            ("bytes=9-3", Wanted::All),
            ("bytes=0-1,4-5", Wanted::All),
            ("lines=0-1", Wanted::All),
            ("bytes=+1-2", Wanted::All),
        ] {
            assert_eq!(wanted(Some(header), 100), expected, "{header}");
        }
        assert_eq!(wanted(None, 100), Wanted::All);
        assert_eq!(wanted(Some("bytes=0-"), 0), Wanted::Nothing);
    }

    proptest! {
        #[test]
        fn no_header_asks_for_what_is_not_there(header in ".{0,20}", tail in "[0-9,-]{0,30}", total: u64) {
            for header in [header.clone(), format!("bytes={tail}"), format!("bytes={header}")] {
                if let Wanted::Part { first, length } = wanted(Some(&header), total) {
                    prop_assert!(length > 0 && first.checked_add(length).is_some_and(|end| end <= total));
                }
            }
        }
    }
}
