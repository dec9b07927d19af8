//! Letters as strokes, so that a PNG needs no font.
//!
//! A letter is drawn on a grid: lower-case letters are 4 high, capitals and digits 6, and
//! two rows below the baseline hold descenders. Each stroke is a chain of grid points, two
//! characters a point: the column, then the row, where `a` and `b` are one and two rows
//! below the baseline. Strokes are parted by spaces; a chain that stays is a dot.

/// Width of a stroke as a share of the size.
pub const WEIGHT: f64 = 0.1;
/// Side of the grid as a share of the size.
const UNIT: f64 = 0.118;
/// Room after a letter, grid units.
const GAP: f64 = 1.7;
/// Width of a space, grid units.
const SPACE: f64 = 2.2;
/// What is drawn for characters that have no strokes: a box.
const UNKNOWN: &str = "0006464000";

#[rustfmt::skip]
fn strokes(letter: char) -> &'static str {
    match letter {
        'a' => "14344340 421201103041", 'b' => "0600 0314344341301001", 'c' => "4334140301103041",
        'd' => "4640 4334140301103041", 'e' => "02424334140301103041", 'f' => "36261510 0434",
        'g' => "444a3b1b0a 4334140301103041", 'h' => "0600 0314344340", 'i' => "0400 0606",
        'j' => "141a0b 1616", 'k' => "0600 3401 1230", 'l' => "0600",
        'm' => "0400 0314243330 3344546360", 'n' => "0400 0314344340", 'o' => "143443413010010314",
        'p' => "040b 0314344341301001", 'q' => "444b 4334140301103041", 'r' => "0400 031434",
        's' => "43341403123241301001", 't' => "16112030 0434", 'u' => "0401103041 4440",
        'v' => "042044", 'w' => "0410345064", 'x' => "0440 0044", 'y' => "0420 441b",
        'z' => "04440040",
        'A' => "002640 1232", 'B' => "00063645443303 3342413000", 'C' => "4536160501103041",
        'D' => "00062644422000", 'E' => "46060040 0333", 'F' => "460600 0333",
        'G' => "45361605011030414323", 'H' => "0006 4046 0343", 'I' => "0006",
        'J' => "4641301001", 'K' => "0006 4602 1340", 'L' => "060040", 'M' => "0006326660",
        'N' => "00064046", 'O' => "163645413010010516", 'P' => "00063645443303",
        'Q' => "163645413010010516 2240", 'R' => "00063645443303 2340",
        'S' => "453616050413334241301001", 'T' => "0646 2620", 'U' => "060110304146",
        'V' => "062046", 'W' => "0610345066", 'X' => "0640 0046", 'Y' => "062346 2320",
        'Z' => "06460040",
        '0' => "163645413010010516", '1' => "051610", '2' => "05163645440040",
        '3' => "051636454433 13334241301001", '4' => "30360242", '5' => "46060314344341301001",
        '6' => "3616050110304142331302", '7' => "064610",
        '8' => "13040516364544331302011030414233", '9' => "1030414536160504133344",
        '.' => "0000", ',' => "100a", ':' => "0000 0303", ';' => "0303 100a", '(' => "1604011a",
        ')' => "0614110a", '-' => "0333", '+' => "0242 2024", '/' => "0036", '%' => "0046 0605 4140",
        '<' => "440240", '>' => "044200", '_' => "0a4a", '\'' => "0605", ' ' => "",
        _ => UNKNOWN,
    }
}

/// The chains of a letter in grid units, y upward.
fn chains(letter: char) -> Vec<Vec<[f64; 2]>> {
    let row = |byte: u8| match byte {
        b'a' => -1.0,
        b'b' => -2.0,
        digit => f64::from(digit.saturating_sub(b'0')),
    };
    let chain = |chain: &str| {
        let points = chain.as_bytes().chunks_exact(2);
        points.map(|point| [row(point[0]), row(point[1])]).collect()
    };
    strokes(letter).split_whitespace().map(chain).collect()
}

fn advance(letter: char) -> f64 {
    let columns = chains(letter).into_iter().flatten().map(|[column, _]| column);
    columns
        .fold(None, |widest: Option<f64>, c| Some(widest.map_or(c, |w| w.max(c))))
        .map_or(SPACE, |widest| widest + GAP)
}

/// Width of a text, in the unit of its size.
pub fn width(text: &str, size: f64) -> f64 {
    text.chars().map(advance).sum::<f64>() * UNIT * size
}

/// The lines of a text from its left end on the baseline, y downward.
pub fn lines(text: &str, size: f64) -> Vec<Vec<[f64; 2]>> {
    let scale = UNIT * size;
    let mut lines = Vec::new();
    let mut left = 0.0;
    for letter in text.chars() {
        for chain in chains(letter) {
            let place = |[x, y]: [f64; 2]| [(left + x) * scale, -y * scale];
            let mut line: Vec<[f64; 2]> = chain.into_iter().map(place).collect();
            if let [only] = line[..] {
                line.push(only);
            }
            lines.push(line);
        }
        left += advance(letter);
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_stays_on_its_grid_and_none_looks_like_another() {
        let letters: Vec<char> = ('0'..='9').chain('a'..='z').chain('A'..='Z').collect();
        for (at, &letter) in letters.iter().enumerate() {
            assert_ne!(strokes(letter), UNKNOWN, "{letter}");
            for [x, y] in chains(letter).into_iter().flatten() {
                assert!((0.0..=6.0).contains(&x) && (-2.0..=6.0).contains(&y), "{letter}");
            }
            let twin = letters[..at].iter().find(|&&other| strokes(other) == strokes(letter));
            let same = twin.is_some_and(|&twin| (twin, letter) != ('0', 'O'));
            assert!(!same, "{letter} looks like {twin:?}");
        }
    }

    #[test]
    fn a_text_is_as_wide_as_its_letters() {
        assert!(width("il", 10.0) < width("mw", 10.0));
        assert_eq!(width("ab", 10.0), width("a", 10.0) + width("b", 10.0));
        assert_eq!(lines("i", 10.0).len(), 2);
        assert!(lines(" ", 10.0).is_empty());
    }
}
