//! The farm token: the one secret that all sides of a farm share.
//!
//! 256 bits from the operating system. As text it is eight groups of eight symbols, which
//! can be typed: letters of either case, no `I`, `L`, `O` or `U`, each group with a
//! check of its own, so that a typo is named by its group. Not here: where it is kept.

use sha2::{Digest, Sha256};
use std::fmt;
use std::str::FromStr;

/// Length of a token, bytes.
pub const TOKEN_BYTES: usize = 32;
/// Number of groups of the text.
const GROUPS: usize = 8;
/// Symbols of a group: 32 bits of the token and 8 of the check, 5 a symbol.
const GROUP_SYMBOLS: usize = 8;
/// Crockford's 32 symbols: none looks like another one.
const SYMBOLS: [u8; 32] = *b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";
/// x^8 + x^4 + x^3 + x^2 + 1, which is primitive: it finds every wrong symbol and every
/// swap of two neighbours.
const CHECK_POLYNOMIAL: u8 = 0x1d;

/// The secret of a farm. Its text is [`FarmToken::to_text`]; `Debug` does not show it.
#[derive(Clone)]
pub struct FarmToken([u8; TOKEN_BYTES]);

/// Why a text is no token. The text itself is not repeated: it may be nearly right.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// Too short or too long.
    #[error("a farm token has {} symbols, this one has {found}", GROUPS * GROUP_SYMBOLS)]
    Length {
        /// Number of symbols, hyphens and spaces not counted.
        found: usize,
    },
    /// Not one of the symbols.
    #[error("{symbol:?} in group {group} of {GROUPS} is no symbol of a farm token")]
    Symbol {
        /// What it is.
        symbol: char,
        /// Where it stands, from 1.
        group: usize,
    },
    /// The check of a group is wrong.
    #[error("group {group} of {GROUPS} of the farm token has a typo, or stands in the wrong place")]
    Typo {
        /// Which one, from 1.
        group: usize,
    },
}

/// The operating system gave no random bytes.
#[derive(Debug, thiserror::Error)]
#[error("the operating system gives no random numbers: {0}")]
pub struct NoRandomness(getrandom::Error);

impl FarmToken {
    /// A new one.
    ///
    /// # Errors
    /// If the operating system has no randomness to give.
    pub fn generate() -> Result<Self, NoRandomness> {
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(NoRandomness)?;
        Ok(FarmToken(bytes))
    }

    /// The token of these bytes, which nobody else may know.
    pub const fn from_bytes(bytes: [u8; TOKEN_BYTES]) -> Self {
        FarmToken(bytes)
    }

    /// The token itself: uniform already, so it is the key that peers share.
    pub(super) fn key(&self) -> &[u8; TOKEN_BYTES] {
        &self.0
    }

    /// A secret for another purpose, from which nobody learns the token or the secret of a
    /// third purpose: HMAC-SHA-256 of `purpose` under the token (RFC 2104).
    pub fn derive(&self, purpose: &str) -> [u8; TOKEN_BYTES] {
        hmac_sha256(&self.0, purpose.as_bytes())
    }

    /// The token as it is typed: whoever reads it can join the farm.
    pub fn to_text(&self) -> String {
        let (words, _) = self.0.as_chunks::<4>();
        let mut text = String::with_capacity(GROUPS * (GROUP_SYMBOLS + 1));
        for (group, word) in words.iter().enumerate() {
            if group > 0 {
                text.push('-');
            }
            let bits = u64::from(u32::from_be_bytes(*word)) << 8 | u64::from(check(group, *word));
            for symbol in (0..GROUP_SYMBOLS).rev() {
                text.push(char::from(SYMBOLS[(bits >> (5 * symbol)) as usize & 31]));
            }
        }
        text
    }
}

impl FromStr for FarmToken {
    type Err = TokenError;

    fn from_str(text: &str) -> Result<Self, TokenError> {
        let symbols = || text.chars().filter(|symbol| *symbol != '-' && !symbol.is_whitespace());
        let found = symbols().count();
        if found != GROUPS * GROUP_SYMBOLS {
            return Err(TokenError::Length { found });
        }
        let mut groups = [0u64; GROUPS];
        for (place, symbol) in symbols().enumerate() {
            let group = place / GROUP_SYMBOLS;
            let value = value_of(symbol).ok_or(TokenError::Symbol { symbol, group: group + 1 })?;
            groups[group] = groups[group] << 5 | value;
        }
        let mut bytes = [0; TOKEN_BYTES];
        let (words, _) = bytes.as_chunks_mut::<4>();
        for (group, (word, bits)) in words.iter_mut().zip(groups).enumerate() {
            *word = ((bits >> 8) as u32).to_be_bytes();
            if check(group, *word) != bits as u8 {
                return Err(TokenError::Typo { group: group + 1 });
            }
        }
        Ok(FarmToken(bytes))
    }
}

impl fmt::Debug for FarmToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("FarmToken(secret)")
    }
}

/// HMAC-SHA-256 with a key that is no longer than a block.
fn hmac_sha256(key: &[u8; TOKEN_BYTES], text: &[u8]) -> [u8; 32] {
    let pad = |with: u8| {
        let mut block = [with; 64];
        for (byte, key) in block.iter_mut().zip(key) {
            *byte ^= key;
        }
        Sha256::new().chain_update(block)
    };
    let inner = pad(0x36).chain_update(text).finalize();
    pad(0x5c).chain_update(inner).finalize().into()
}

/// What a symbol stands for; look-alikes are taken for what they look like.
fn value_of(symbol: char) -> Option<u64> {
    let symbol = match symbol.to_ascii_uppercase() {
        'O' => '0',
        'I' | 'L' => '1',
        other => other,
    };
    SYMBOLS.iter().position(|known| char::from(*known) == symbol).map(|value| value as u64)
}

/// The check of a group: a CRC-8 that begins with the number of the group, so that a group
/// in the place of another one is found as well.
fn check(group: usize, word: [u8; 4]) -> u8 {
    word.iter().fold(group as u8 + 1, |sum, byte| {
        (0..8).fold(sum ^ byte, |sum, _| {
            let carry = if sum & 0x80 == 0 { 0 } else { CHECK_POLYNOMIAL };
            sum << 1 ^ carry
        })
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_text_of_a_token_never_changes() {
        let bytes = std::array::from_fn(|index| index as u8 * 7 + 3);
        let text = FarmToken(bytes).to_text();
        assert_eq!(text, GOLDEN);
        assert_eq!(text.parse::<FarmToken>().unwrap().0, bytes);
    }

    const GOLDEN: &str = "0C51267N-3WK2TD1F-7D14JM5J-AXF6AV4C-EDX8324Y-HYB9V93T-NESBKG3D-RZ7DBQ7J";

    #[test]
    fn tokens_differ_and_are_not_shown() {
        let (one, other) = (FarmToken::generate().unwrap(), FarmToken::generate().unwrap());
        assert_ne!(one.0, other.0);
        assert_ne!(one.0, [0; TOKEN_BYTES]);
        assert_eq!(format!("{one:?}"), "FarmToken(secret)");
    }

    #[test]
    fn derived_secrets_differ_by_purpose_and_are_those_of_hmac_sha_256() {
        // Test case 2 of RFC 4231: a short key is one that ends in zeros.
        let mut key = [0; TOKEN_BYTES];
        key[..4].copy_from_slice(b"Jefe");
        let mac = FarmToken(key).derive("what do ya want for nothing?");
        let hex: String = mac.iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(hex, "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843");
        assert_ne!(FarmToken(key).derive("one"), FarmToken(key).derive("other"));
    }

    #[test]
    fn what_is_no_token_is_told_apart() {
        let wrong = |text: &str| text.parse::<FarmToken>().unwrap_err();
        assert_eq!(wrong(""), TokenError::Length { found: 0 });
        assert_eq!(wrong(&"0".repeat(65)), TokenError::Length { found: 65 });
        let text = GOLDEN.replacen('-', "-?", 1);
        let text = &text[..text.len() - 1];
        assert_eq!(wrong(text), TokenError::Symbol { symbol: '?', group: 2 });
    }

    proptest! {
        #[test]
        fn a_token_is_read_however_it_is_typed(bytes: [u8; TOKEN_BYTES], lower: bool) {
            let mut text = FarmToken(bytes).to_text();
            if lower {
                text = text.to_lowercase().replace('1', "l").replace('0', "o").replace('-', " ");
            }
            prop_assert_eq!(text.parse::<FarmToken>().map(|token| token.0), Ok(bytes));
        }

        #[test]
        fn every_wrong_symbol_and_every_swap_of_neighbours_is_named_by_its_group(
            bytes: [u8; TOKEN_BYTES],
        ) {
            let symbols: Vec<char> = FarmToken(bytes).to_text().replace('-', "").chars().collect();
            let read = |symbols: &[char]| symbols.iter().collect::<String>().parse::<FarmToken>();
            for place in 0..symbols.len() {
                let mut typo = symbols.clone();
                for symbol in SYMBOLS.map(char::from) {
                    typo[place] = symbol;
                    if symbol != symbols[place] {
                        let group = place / GROUP_SYMBOLS + 1;
                        prop_assert_eq!(read(&typo).unwrap_err(), TokenError::Typo { group });
                    }
                }
                let next = place + 1;
                let same_group = next % GROUP_SYMBOLS != 0;
                if same_group && symbols[place] != symbols[next] {
                    let mut swapped = symbols.clone();
                    swapped.swap(place, next);
                    prop_assert!(read(&swapped).is_err());
                }
            }
        }

        #[test]
        fn groups_that_change_places_are_noticed(bytes: [u8; TOKEN_BYTES], a in 0..8usize, b in 0..8usize) {
            let text = FarmToken(bytes).to_text();
            let mut groups: Vec<&str> = text.split('-').collect();
            groups.swap(a, b);
            prop_assert_eq!(groups.join("-").parse::<FarmToken>().is_ok(), a == b);
        }

        #[test]
        fn no_text_panics(text in ".{0,80}") {
            let _ = text.parse::<FarmToken>();
        }
    }
}
