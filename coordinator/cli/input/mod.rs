//! What a user writes by hand: the scene and the flight.
//!
//! Both are small text files. Their errors name the file, the line and what to change;
//! nothing in them can make the program panic or allocate without bound.

pub mod csv;
pub mod flight;
pub mod scene;

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use terrafarm_common::quality::{Method, Quality};

/// A mistake in an input file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputError {
    /// The file.
    pub file: PathBuf,
    /// Line, from 1, if the mistake is on one.
    pub line: Option<usize>,
    /// What is wrong, and what to do.
    pub message: String,
}

impl InputError {
    /// A mistake of the file as a whole.
    pub fn in_file(file: &Path, message: impl Into<String>) -> Self {
        InputError { file: file.to_path_buf(), line: None, message: message.into() }
    }

    /// A mistake on a line, counted from 1.
    pub fn on_line(file: &Path, line: usize, message: impl Into<String>) -> Self {
        InputError { line: Some(line), ..Self::in_file(file, message) }
    }
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        write!(f, ": {}", self.message)
    }
}

impl std::error::Error for InputError {}

/// The text of a file of at most `limit` bytes, without a byte order mark.
fn read_text(file: &Path, limit: u64) -> Result<String, InputError> {
    let mut bytes = Vec::new();
    let read = File::open(file).and_then(|f| f.take(limit + 1).read_to_end(&mut bytes));
    read.map_err(|error| InputError::in_file(file, format!("cannot be read: {error}")))?;
    if bytes.len() as u64 > limit {
        let message = format!("is larger than {} MiB; is it the right file?", limit >> 20);
        return Err(InputError::in_file(file, message));
    }
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    String::from_utf8(bytes.to_vec())
        .map_err(|_| InputError::in_file(file, "is not UTF-8 text; save it as UTF-8"))
}

/// A method by its name. A mistyped one is answered with the nearest.
pub fn parse_method(text: &str) -> Result<Method, String> {
    text.parse().map_err(|error: String| match nearest(text, &Method::ALL.map(Method::name)) {
        Some(near) => format!("{error}; did you mean \"{near}\"?"),
        None => error,
    })
}

/// A tolerance in pixels as people write it: `0.5`.
pub fn parse_tolerance(text: &str) -> Result<f64, String> {
    let allowed = Quality::MIN_TOLERANCE_PX..=Quality::MAX_TOLERANCE_PX;
    text.trim().parse().ok().filter(|number| allowed.contains(number)).ok_or_else(|| {
        format!(
            "a tolerance is a number of pixels from {} to {}, such as {}",
            allowed.start(),
            allowed.end(),
            Quality::DEFAULT_TOLERANCE_PX
        )
    })
}

/// The known word nearest to a mistyped one, if one is near.
fn nearest<'a>(word: &str, known: &[&'a str]) -> Option<&'a str> {
    let allowed = word.chars().count() / 3 + 1;
    let near = known.iter().map(|other| (distance(word, other), *other));
    near.filter(|(steps, _)| *steps <= allowed).min_by_key(|(steps, _)| *steps).map(|(_, w)| w)
}

/// Number of letters to insert, delete or change (Levenshtein).
fn distance(one: &str, other: &str) -> usize {
    let other: Vec<char> = other.chars().collect();
    let mut row: Vec<usize> = (0..=other.len()).collect();
    for (i, a) in one.chars().take(64).enumerate() {
        let mut diagonal = i;
        row[0] = i + 1;
        for (j, b) in other.iter().enumerate() {
            let changed = diagonal + usize::from(a != *b);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[other.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_word_is_found_if_it_is_near() {
        let known = ["heading", "height", "pitch"];
        assert_eq!(nearest("heding", &known), Some("heading"));
        assert_eq!(nearest("hieght", &known), Some("height"));
        assert_eq!(nearest("pich", &known), Some("pitch"));
        assert_eq!(nearest("speed", &known), None);
    }

    #[test]
    fn a_mistyped_method_is_answered_with_the_nearest() {
        assert_eq!(parse_method("lod"), Ok(Method::Lod));
        let error = parse_method("colunm").expect_err("it is mistyped");
        assert!(error.ends_with("did you mean \"column\"?"), "{error}");
        let error = parse_method("quickest").expect_err("there is no such method");
        assert!(error.contains("choose one of auto, exact, lod"), "{error}");
        assert!(!error.contains("did you mean"), "{error}");
    }

    #[test]
    fn a_tolerance_is_within_its_limits_or_refused() {
        assert_eq!(parse_tolerance("0.5"), Ok(0.5));
        assert_eq!(parse_tolerance("0.01"), Ok(0.01));
        assert_eq!(parse_tolerance("64"), Ok(64.0));
        for wrong in ["0", "-1", "0.009", "64.1", "nan", "inf", "-inf", "", "half", "1px"] {
            let error = parse_tolerance(wrong).expect_err(wrong);
            assert!(error.contains("0.01 to 64"), "{wrong}: {error}");
        }
    }

    #[test]
    fn an_error_names_the_file_and_the_line() {
        let error = InputError::on_line(Path::new("a.csv"), 7, "no");
        assert_eq!(error.to_string(), "a.csv:7: no");
    }
}
