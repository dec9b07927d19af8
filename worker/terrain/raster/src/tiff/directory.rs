//! The directories of a TIFF: tags and their values, classic and BigTIFF, both byte orders.
//!
//! Written here, not taken from the `tiff` crate: that one computes with declared sizes
//! before it checks them, and its limit on the offset table cannot be raised before the
//! first directory is read. Its decoder serves the tests as a second opinion.

use crate::info::RasterError;
use crate::limits::{MAX_DIRECTORIES, MAX_ENTRIES, MAX_TAG_BYTES};
use crate::source::Source;
use std::collections::{BTreeMap, HashSet};

/// Byte order of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// `II`.
    Little,
    /// `MM`.
    Big,
}

impl Order {
    /// An unsigned number of up to 8 bytes.
    pub fn unsigned(self, bytes: &[u8]) -> u64 {
        let join = |value: u64, byte: &u8| value << 8 | u64::from(*byte);
        match self {
            Order::Little => bytes.iter().rev().fold(0, join),
            Order::Big => bytes.iter().fold(0, join),
        }
    }
}

/// Where a tag's values lie.
struct Entry {
    kind: u16,
    count: u64,
    /// The values, or their position.
    value: Vec<u8>,
}

/// One directory.
pub struct Directory {
    /// Byte order of the file.
    pub order: Order,
    entries: BTreeMap<u16, Entry>,
    next: u64,
}

/// Bytes of one value of a type; 0 for types that no standard knows.
fn kind_bytes(kind: u16) -> u64 {
    match kind {
        1 | 2 | 6 | 7 => 1,
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16 | 17 | 18 => 8,
        _ => 0,
    }
}

/// The directory that holds the picture at full resolution, and how many others hold a
/// transparency mask (the first number) or a further picture (the second).
///
/// Overviews and masks are told by NewSubfileType; the first directory that is neither
/// counts. A chain that loops or breaks behind it does no harm.
pub fn find_image(source: &Source) -> Result<(Directory, usize, usize), RasterError> {
    let head = source.head(16)?;
    let damaged = |what: &str| RasterError::damaged(source.path(), what);
    let order = match head.get(..2) {
        Some(b"II") => Order::Little,
        Some(b"MM") => Order::Big,
        _ => return Err(damaged("a TIFF begins with II or MM")),
    };
    let (big, first) = match (head.get(2..4).map(|bytes| order.unsigned(bytes)), head.len()) {
        (Some(42), 8..) => (false, order.unsigned(&head[4..8])),
        (Some(43), 16..) if order.unsigned(&head[4..6]) == 8 => {
            (true, order.unsigned(&head[8..16]))
        }
        _ => return Err(damaged("the header of a TIFF is cut short or damaged")),
    };
    let (mut found, mut masks, mut others) = (None, 0, 0);
    let (mut offset, mut seen) = (first, HashSet::new());
    while offset != 0 && seen.len() < MAX_DIRECTORIES && seen.insert(offset) {
        let directory = match Directory::read(source, order, big, offset) {
            Ok(directory) => directory,
            Err(error) if found.is_none() => return Err(error),
            Err(_) => break,
        };
        offset = directory.next;
        match directory.number(source, 254).unwrap_or(None).unwrap_or(0) {
            kind if kind & 4 != 0 => masks += 1,
            kind if kind & 1 != 0 => {}
            _ if found.is_none() => found = Some(directory),
            _ => others += 1,
        }
    }
    match found {
        Some(directory) => Ok((directory, masks, others)),
        None => Err(damaged("none of the directories holds a picture at full resolution")),
    }
}

impl Directory {
    fn read(source: &Source, order: Order, big: bool, at: u64) -> Result<Self, RasterError> {
        let (count_bytes, entry_bytes, word) = if big { (8, 20, 8) } else { (2, 12, 4) };
        let count = order.unsigned(&source.bytes_at(at, count_bytes)?);
        if count > MAX_ENTRIES {
            let what =
                format!("the directory at byte {at} declares {count} entries; it is damaged");
            return Err(RasterError::damaged(source.path(), what));
        }
        let bytes = source.bytes_at(at + count_bytes, count * entry_bytes + word)?;
        let (table, next) = bytes.split_at((count * entry_bytes) as usize);
        let mut entries = BTreeMap::new();
        for entry in table.chunks_exact(entry_bytes as usize) {
            let (head, value) = entry.split_at(entry.len() - word as usize);
            entries.entry(order.unsigned(&head[..2]) as u16).or_insert(Entry {
                kind: order.unsigned(&head[2..4]) as u16,
                count: order.unsigned(&head[4..]),
                value: value.to_vec(),
            });
        }
        Ok(Directory { order, entries, next: order.unsigned(next) })
    }

    /// The bytes of a tag in the file's order, its type, and bytes per value.
    fn raw(
        &self,
        source: &Source,
        tag: u16,
        limit_bytes: u64,
    ) -> Result<Option<(Vec<u8>, u16, usize)>, RasterError> {
        let Some(entry) = self.entries.get(&tag) else { return Ok(None) };
        let damaged = |what: String| Err(RasterError::damaged(source.path(), what));
        let size = kind_bytes(entry.kind);
        if size == 0 {
            return damaged(format!("tag {tag} has the unknown type {}", entry.kind));
        }
        let length = entry.count.saturating_mul(size);
        if length > limit_bytes {
            return damaged(format!(
                "tag {tag} declares {} values, {length} bytes; at most {limit_bytes} are read",
                entry.count
            ));
        }
        let bytes = if length <= entry.value.len() as u64 {
            entry.value[..length as usize].to_vec()
        } else {
            source.bytes_at(self.order.unsigned(&entry.value), length)?
        };
        Ok(Some((bytes, entry.kind, size as usize)))
    }

    /// All values of a tag of unsigned whole numbers, at most `limit` of them.
    pub fn numbers(
        &self,
        source: &Source,
        tag: u16,
        limit: u64,
    ) -> Result<Option<Vec<u64>>, RasterError> {
        let Some((bytes, kind, size)) = self.raw(source, tag, limit * 8)? else { return Ok(None) };
        if !matches!(kind, 1 | 3 | 4 | 13 | 16 | 18) {
            let what = format!("tag {tag} has type {kind}, not one of whole numbers");
            return Err(RasterError::damaged(source.path(), what));
        }
        Ok(Some(bytes.chunks_exact(size).map(|value| self.order.unsigned(value)).collect()))
    }

    /// The first value of a tag of unsigned whole numbers.
    pub fn number(&self, source: &Source, tag: u16) -> Result<Option<u64>, RasterError> {
        let numbers = self.numbers(source, tag, MAX_TAG_BYTES / 8)?;
        Ok(numbers.and_then(|numbers| numbers.first().copied()))
    }

    /// All values of a tag of floating-point numbers; empty if there is none.
    pub fn doubles(&self, source: &Source, tag: u16) -> Result<Vec<f64>, RasterError> {
        let Some((bytes, kind, size)) = self.raw(source, tag, MAX_TAG_BYTES)? else {
            return Ok(Vec::new());
        };
        let values = bytes.chunks_exact(size).map(|value| self.order.unsigned(value));
        match kind {
            11 => Ok(values.map(|bits| f64::from(f32::from_bits(bits as u32))).collect()),
            12 => Ok(values.map(f64::from_bits).collect()),
            _ => {
                let what = format!("tag {tag} has type {kind}, not one of floating-point numbers");
                Err(RasterError::damaged(source.path(), what))
            }
        }
    }

    /// A tag of text, up to its first zero.
    pub fn text(&self, source: &Source, tag: u16) -> Result<Option<String>, RasterError> {
        let Some((bytes, ..)) = self.raw(source, tag, MAX_TAG_BYTES)? else { return Ok(None) };
        let text = bytes.split(|&byte| byte == 0).next().unwrap_or_default();
        Ok(Some(String::from_utf8_lossy(text).into_owned()))
    }
}
