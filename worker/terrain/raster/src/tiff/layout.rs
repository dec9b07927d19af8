//! How a TIFF's samples are stored, checked once, and how a strip or tile is decoded.

use crate::info::RasterError;
use crate::limits::{MAX_CHUNK_BYTES, MAX_CHUNKS, MAX_SIDE};
use crate::source::{Source, conversion_hint};
use crate::tiff::codec::{Compression, decompress, to_native};
use crate::tiff::directory::{Directory, Order};

/// What one sample is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleKind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    F32,
    F64,
}

impl SampleKind {
    /// Bytes of one sample.
    pub fn bytes(self) -> usize {
        match self {
            SampleKind::U8 | SampleKind::I8 => 1,
            SampleKind::U16 | SampleKind::I16 => 2,
            SampleKind::U32 | SampleKind::I32 | SampleKind::F32 => 4,
            SampleKind::F64 => 8,
        }
    }

    /// The name GIS people use.
    pub fn name(self) -> &'static str {
        match self {
            SampleKind::U8 => "uint8",
            SampleKind::I8 => "int8",
            SampleKind::U16 => "uint16",
            SampleKind::I16 => "int16",
            SampleKind::U32 => "uint32",
            SampleKind::I32 => "int32",
            SampleKind::F32 => "float32",
            SampleKind::F64 => "float64",
        }
    }

    /// Whether every sample is a whole number.
    pub fn is_whole(self) -> bool {
        !matches!(self, SampleKind::F32 | SampleKind::F64)
    }

    /// Whether a sample can have that value.
    pub fn holds(self, value: f64) -> bool {
        let (low, high) = match self {
            SampleKind::U8 => (0.0, f64::from(u8::MAX)),
            SampleKind::I8 => (f64::from(i8::MIN), f64::from(i8::MAX)),
            SampleKind::U16 => (0.0, f64::from(u16::MAX)),
            SampleKind::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            SampleKind::U32 => (0.0, f64::from(u32::MAX)),
            SampleKind::I32 => (f64::from(i32::MIN), f64::from(i32::MAX)),
            SampleKind::F32 | SampleKind::F64 => return true,
        };
        value == value.trunc() && (low..=high).contains(&value)
    }

    /// Calls `each` with every `stride`-th sample of native bytes, beginning at `first`.
    pub fn for_each(self, bytes: &[u8], first: usize, stride: usize, mut each: impl FnMut(f64)) {
        macro_rules! walk {
            ($type:ty) => {
                bytes
                    .as_chunks::<{ size_of::<$type>() }>()
                    .0
                    .iter()
                    .skip(first)
                    .step_by(stride)
                    .for_each(|sample| each(f64::from(<$type>::from_ne_bytes(*sample))))
            };
        }
        match self {
            SampleKind::U8 => walk!(u8),
            SampleKind::I8 => walk!(i8),
            SampleKind::U16 => walk!(u16),
            SampleKind::I16 => walk!(i16),
            SampleKind::U32 => walk!(u32),
            SampleKind::I32 => walk!(i32),
            SampleKind::F32 => walk!(f32),
            SampleKind::F64 => walk!(f64),
        }
    }
}

/// The storage of a TIFF's picture.
pub struct Layout {
    /// Samples along a row, and rows.
    pub size: [u64; 2],
    /// What one sample is.
    pub kind: SampleKind,
    /// Samples per pixel.
    pub bands: usize,
    /// Whether each band has strips or tiles of its own.
    pub separate: bool,
    /// Photometric interpretation.
    pub photometric: u64,
    /// Width and height of a strip or tile, pixels.
    pub chunk: [u64; 2],
    /// Whether there are tiles, not strips.
    pub tiled: bool,
    /// Compression of strips and tiles.
    pub compression: Compression,
    predictor: u64,
    order: Order,
    across: u64,
    down: u64,
    offsets: Vec<u64>,
    lengths: Vec<u64>,
}

impl Layout {
    /// Reads and checks everything that decoding relies on.
    pub fn read(source: &Source, directory: &Directory) -> Result<Self, RasterError> {
        let path = source.path();
        let number = |tag: u16| directory.number(source, tag);
        let required = |tag: u16, name: &str| {
            number(tag)?.filter(|&value| value > 0).ok_or_else(|| {
                RasterError::damaged(
                    path,
                    format!("the directory has no usable {name} (tag {tag})"),
                )
            })
        };
        let size = [required(256, "width")?, required(257, "height")?];
        if size.iter().any(|&side| side > MAX_SIDE) {
            let what = format!(
                "{} x {} samples are declared; at most {MAX_SIDE} along a side are read",
                size[0], size[1]
            );
            return Err(RasterError::damaged(path, what));
        }
        let bands = number(277)?.unwrap_or(1);
        if !(1..=4096).contains(&bands) {
            return Err(RasterError::damaged(path, format!("{bands} bands are declared")));
        }
        let compression = compression(source, number(259)?.unwrap_or(1))?;
        let predictor = number(317)?.unwrap_or(1);
        let kind = sample_kind(source, directory)?;
        if !(predictor == 1
            || predictor == 2
            || predictor == 3 && matches!(kind, SampleKind::F32 | SampleKind::F64))
        {
            let what = format!("predictor {predictor} is not defined for {}", kind.name());
            return Err(RasterError::damaged(path, what));
        }
        let separate = bands > 1 && number(284)?.unwrap_or(1) == 2;
        let tiled = number(322)?.is_some();
        let chunk = if tiled {
            [required(322, "tile width")?, required(323, "tile height")?]
        } else {
            [size[0], number(278)?.unwrap_or(size[1]).clamp(1, size[1])]
        };
        let per_pixel = if separate { 1 } else { bands } * kind.bytes() as u64;
        let chunk_bytes = chunk[0].checked_mul(chunk[1]).and_then(|n| n.checked_mul(per_pixel));
        if !chunk_bytes.is_some_and(|bytes| bytes <= MAX_CHUNK_BYTES) {
            let what = format!(
                "a strip or tile of {} x {} pixels is too large to be held in memory (limit \
                 {MAX_CHUNK_BYTES} bytes); {}",
                chunk[0],
                chunk[1],
                conversion_hint(path)
            );
            return Err(RasterError::unsupported(path, what));
        }
        let (across, down) = (size[0].div_ceil(chunk[0]), size[1].div_ceil(chunk[1]));
        let planes = if separate { bands } else { 1 };
        let chunks = (across * down).saturating_mul(planes);
        let tags = if tiled { (324, 325) } else { (273, 279) };
        if chunks > MAX_CHUNKS {
            let what = format!(
                "{chunks} strips or tiles; at most {MAX_CHUNKS} are read; {}",
                conversion_hint(path)
            );
            return Err(RasterError::unsupported(path, what));
        }
        let table = |tag: u16| {
            let values = directory.numbers(source, tag, MAX_CHUNKS)?.unwrap_or_default();
            if (values.len() as u64) < chunks {
                let what = format!(
                    "tag {tag} lists {} strips or tiles, {} x {} samples need {chunks}; the file \
                     is damaged",
                    values.len(),
                    size[0],
                    size[1]
                );
                return Err(RasterError::damaged(path, what));
            }
            Ok(values)
        };
        Ok(Layout {
            offsets: table(tags.0)?,
            lengths: table(tags.1)?,
            photometric: number(262)?.unwrap_or(1),
            order: directory.order,
            bands: bands as usize,
            size,
            kind,
            separate,
            chunk,
            tiled,
            compression,
            predictor,
            across,
            down,
        })
    }

    /// Number of the strip or tile of a block column and row in a plane.
    pub fn chunk_number(&self, bx: u64, by: u64, plane: usize) -> u64 {
        plane as u64 * self.across * self.down + by * self.across + bx
    }

    /// How many strips or tiles lie beside and below each other.
    pub fn chunks(&self) -> [u64; 2] {
        [self.across, self.down]
    }

    /// Rows of the chunks in a block row: strips end with the picture, tiles do not.
    pub fn chunk_rows(&self, by: u64) -> u64 {
        if self.tiled {
            self.chunk[1]
        } else {
            self.chunk[1].min(self.size[1] - by * self.chunk[1])
        }
    }

    /// The samples of a strip or tile in this machine's byte order; `None` if it is left
    /// out of the file (sparse), which stands for no data.
    pub fn decode(
        &self,
        source: &Source,
        bx: u64,
        by: u64,
        plane: usize,
    ) -> Result<Option<Vec<u8>>, RasterError> {
        let number = self.chunk_number(bx, by, plane) as usize;
        let (offset, length) = (self.offsets[number], self.lengths[number]);
        if length == 0 {
            return Ok(None);
        }
        let stride = if self.separate { 1 } else { self.bands };
        let row = self.chunk[0] as usize * stride * self.kind.bytes();
        let expected = row * self.chunk_rows(by) as usize;
        let stored = match self.compression {
            Compression::None => length.min(expected as u64),
            _ => length,
        };
        if stored > 2 * MAX_CHUNK_BYTES {
            let what = format!("{} {number} declares {length} bytes", self.chunk_word());
            return Err(RasterError::damaged(source.path(), what));
        }
        let stored = source.bytes_at(offset, stored)?;
        let mut bytes = decompress(self.compression, stored, expected).map_err(|why| {
            let what = format!(
                "{} {number} at byte {offset} cannot be decoded: {why}; the file is damaged: \
                 fetch it again",
                self.chunk_word()
            );
            RasterError::damaged(source.path(), what)
        })?;
        to_native(&mut bytes, self.predictor, self.order, self.kind.bytes(), stride, row);
        Ok(Some(bytes))
    }

    fn chunk_word(&self) -> &'static str {
        if self.tiled { "tile" } else { "strip" }
    }

    /// "int16, DEFLATE, tiled".
    pub fn describe(&self) -> String {
        let compression = match self.compression {
            Compression::None => "uncompressed",
            Compression::Lzw => "LZW",
            Compression::Deflate => "DEFLATE",
            Compression::PackBits => "PackBits",
        };
        let tiled = if self.tiled { "tiled" } else { "strips" };
        format!("{}, {compression}, {tiled}", self.kind.name())
    }
}

fn compression(source: &Source, code: u64) -> Result<Compression, RasterError> {
    let name = match code {
        1 => return Ok(Compression::None),
        5 => return Ok(Compression::Lzw),
        8 | 32946 => return Ok(Compression::Deflate),
        32773 => return Ok(Compression::PackBits),
        2..=4 => "CCITT fax",
        6 | 7 => "JPEG",
        34887 => "LERC",
        34925 => "LZMA",
        50000 => "ZSTD",
        50001 => "WebP",
        50002 => "JPEG XL",
        _ => "unknown",
    };
    let what = format!(
        "compression {code} ({name}) inside a TIFF is not read; {}",
        conversion_hint(source.path())
    );
    Err(RasterError::unsupported(source.path(), what))
}

fn sample_kind(source: &Source, directory: &Directory) -> Result<SampleKind, RasterError> {
    let same = |tag: u16, default: u64| {
        let values = directory.numbers(source, tag, 4096)?.unwrap_or_default();
        let first = values.first().copied().unwrap_or(default);
        Ok(if values.iter().all(|&value| value == first) { first } else { u64::MAX })
    };
    let (bits, format) = (same(258, 1)?, same(339, 1)?);
    match (bits, format) {
        (8, 1 | 4) => Ok(SampleKind::U8),
        (8, 2) => Ok(SampleKind::I8),
        (16, 1 | 4) => Ok(SampleKind::U16),
        (16, 2) => Ok(SampleKind::I16),
        (32, 1 | 4) => Ok(SampleKind::U32),
        (32, 2) => Ok(SampleKind::I32),
        (32, 3) => Ok(SampleKind::F32),
        (64, 3) => Ok(SampleKind::F64),
        _ => {
            let path = source.path();
            let kind = match (bits, format) {
                (u64::MAX, _) | (_, u64::MAX) => "bands of different types".to_owned(),
                (bits, 1) => format!("{bits}-bit samples"),
                (bits, 2) => format!("signed {bits}-bit samples"),
                (bits, 3) => format!("{bits}-bit floating point"),
                (bits, format) => format!("{bits}-bit samples of format {format}"),
            };
            let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
            let what = format!(
                "{kind} are not read; convert it with: gdal_translate -ot Float32 (heights) or \
                 -ot Byte -expand rgb (photo) \"{name}\" out.tif"
            );
            Err(RasterError::unsupported(path, what))
        }
    }
}
