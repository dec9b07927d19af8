//! A proj string as a list of parameters that can be looked up and rewritten.

use std::fmt;

/// Parameters in the order in which they were written; `+no_defs` has no value.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ProjString {
    parameters: Vec<(String, Option<String>)>,
}

impl ProjString {
    /// Splits `+name=value` words; the plus signs may be missing. Values keep their
    /// case, names are lower-cased except for the few that differ only by case. Of
    /// several words with one name the first counts, as in PROJ.
    pub(crate) fn parse(text: &str) -> Self {
        let mut parsed = ProjString::default();
        let is_gap = |c: char| c.is_whitespace() || c == '\0' || c == '\u{feff}';
        for word in text.split(is_gap).filter(|word| !word.is_empty()) {
            let word = word.strip_prefix('+').unwrap_or(word);
            let (name, value) = match word.split_once('=') {
                Some((name, value)) => (name, Some(value.trim_matches('"').to_owned())),
                None => (word, None),
            };
            // R and r, R_A and R_a mean different things.
            let name = if name.starts_with('R') { name.into() } else { name.to_lowercase() };
            let is_known = parsed.parameters.iter().any(|(known, _)| *known == name);
            if !name.is_empty() && !is_known {
                parsed.parameters.push((name, value));
            }
        }
        parsed
    }

    /// The value of a parameter; `None` if it is absent or a bare flag.
    pub(crate) fn get(&self, name: &str) -> Option<&str> {
        self.parameters.iter().find(|(n, _)| n == name).and_then(|(_, value)| value.as_deref())
    }

    /// The value as a number, if it is one.
    pub(crate) fn number(&self, name: &str) -> Option<f64> {
        self.get(name)?.parse().ok().filter(|value: &f64| value.is_finite())
    }

    /// Sets or replaces a parameter.
    pub(crate) fn set(&mut self, name: &str, value: impl Into<String>) {
        self.remove(name);
        self.parameters.push((name.to_owned(), Some(value.into())));
    }

    /// Sets a number, written so that it reads back exactly.
    pub(crate) fn set_number(&mut self, name: &str, value: f64) {
        self.set(name, value.to_string());
    }

    /// Takes a parameter away and returns its value.
    pub(crate) fn remove(&mut self, name: &str) -> Option<String> {
        let at = self.parameters.iter().position(|(n, _)| n == name)?;
        self.parameters.remove(at).1
    }

    /// Without the words that change nothing, sorted: equal for equal definitions.
    pub(crate) fn sorted(&self) -> Self {
        let idle = ["no_defs", "type", "wktext"];
        let neutral = |name: &str, value: &Option<String>| {
            let number = value.as_deref().and_then(|text| text.parse::<f64>().ok());
            match name {
                "x_0" | "y_0" | "lat_0" | "lon_0" => number == Some(0.0),
                "k" | "k0" => number == Some(1.0),
                "units" => value.as_deref() == Some("m"),
                _ => idle.contains(&name),
            }
        };
        let mut parameters = self.parameters.clone();
        parameters.retain(|(name, value)| !neutral(name, value));
        parameters.sort();
        ProjString { parameters }
    }
}

impl fmt::Display for ProjString {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, (name, value)) in self.parameters.iter().enumerate() {
            let gap = if number == 0 { "" } else { " " };
            match value {
                Some(value) => write!(f, "{gap}+{name}={value}")?,
                None => write!(f, "{gap}+{name}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_several_words_with_one_name_the_first_counts_whatever_its_case() {
        let parsed = ProjString::parse("+proj=tmerc +lon_0=9 +Lon_0=10 +south +south=1 +south");
        assert_eq!(parsed.to_string(), "+proj=tmerc +lon_0=9 +south");
        assert_eq!(ProjString::parse(&parsed.to_string()), parsed);
    }

    #[test]
    fn nothing_that_is_trimmed_from_a_text_stays_in_a_value() {
        let parsed = ProjString::parse("+proj=utm\u{b}+zone=12\0\u{c}\u{feff}+south\u{a0}");
        assert_eq!(parsed.to_string(), "+proj=utm +zone=12 +south");
    }

    #[test]
    fn names_that_differ_only_by_case_stay_apart() {
        let text = "+proj=merc +R=6370997 +R_A +r=1";
        assert_eq!(ProjString::parse(text).to_string(), text);
    }
}
