//! The bytes of a raster and the small files that lie beside it.
//!
//! Decoders read through a [`Source`], which is a file or a piece of memory, so that a
//! test needs no file. It is shared by threads: each read takes a lock for as long as the
//! bytes are copied; decoding happens outside of it.

use crate::info::RasterError;
use crate::limits::MAX_SIDECAR_BYTES;
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// What a source reads from.
pub trait ReadSeek: Read + Seek + Send {}
impl<T: Read + Seek + Send> ReadSeek for T {}

/// The text files that may lie beside a raster.
#[derive(Debug, Clone, Default)]
pub struct Sidecars {
    /// The world file: six numbers.
    pub world: Option<String>,
    /// The .prj file: WKT.
    pub prj: Option<String>,
    /// The .aux.xml file of GDAL.
    pub aux: Option<String>,
}

/// The bytes of one raster file.
pub struct Source {
    path: PathBuf,
    length: u64,
    reader: Mutex<Box<dyn ReadSeek>>,
    sidecars: Sidecars,
}

impl Source {
    /// Opens a file and reads what lies beside it.
    ///
    /// # Errors
    /// If the system refuses to open the file, or it is not a plain file.
    pub fn open(path: &Path) -> Result<Self, RasterError> {
        let file = File::open(path).map_err(|source| RasterError::io(path, source))?;
        let metadata = file.metadata().map_err(|source| RasterError::io(path, source))?;
        if !metadata.is_file() {
            let what = "this is not a plain file; name the raster file itself";
            return Err(RasterError::unsupported(path, what));
        }
        Ok(Source {
            path: path.to_owned(),
            length: metadata.len(),
            reader: Mutex::new(Box::new(file)),
            sidecars: Sidecars::beside(path),
        })
    }

    /// Bytes in memory under a name; nothing lies beside them but what is given.
    pub fn from_bytes(name: impl Into<PathBuf>, bytes: Vec<u8>, sidecars: Sidecars) -> Self {
        Source {
            path: name.into(),
            length: bytes.len() as u64,
            reader: Mutex::new(Box::new(Cursor::new(bytes))),
            sidecars,
        }
    }

    /// The name, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Length in bytes.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// What lies beside the file.
    pub fn sidecars(&self) -> &Sidecars {
        &self.sidecars
    }

    /// Fills `into` from the given position.
    ///
    /// # Errors
    /// If the file ends before, or the system fails.
    pub fn read_at(&self, offset: u64, into: &mut [u8]) -> Result<(), RasterError> {
        self.check_range(offset, into.len() as u64)?;
        let mut reader = self.reader.lock().unwrap_or_else(PoisonError::into_inner);
        let read = reader.seek(SeekFrom::Start(offset)).and_then(|_| reader.read_exact(into));
        read.map_err(|source| RasterError::io(&self.path, source))
    }

    /// `length` bytes from the given position. The length is checked against the file
    /// before anything is allocated.
    ///
    /// # Errors
    /// As [`Source::read_at`].
    pub fn bytes_at(&self, offset: u64, length: u64) -> Result<Vec<u8>, RasterError> {
        self.check_range(offset, length)?;
        let mut bytes = vec![0; length as usize];
        self.read_at(offset, &mut bytes)?;
        Ok(bytes)
    }

    /// The first bytes, at most `length` of them.
    ///
    /// # Errors
    /// If the system fails.
    pub fn head(&self, length: u64) -> Result<Vec<u8>, RasterError> {
        self.bytes_at(0, length.min(self.length))
    }

    /// The whole file, if it is not longer than `limit`.
    ///
    /// # Errors
    /// If it is longer, or the system fails.
    pub fn whole(&self, limit: u64) -> Result<Vec<u8>, RasterError> {
        if self.length > limit {
            let what = format!(
                "the file has {} bytes; this format has to be held in memory, and at most \
                 {limit} are read; {}",
                self.length,
                conversion_hint(&self.path)
            );
            return Err(RasterError::unsupported(&self.path, what));
        }
        self.bytes_at(0, self.length)
    }

    fn check_range(&self, offset: u64, length: u64) -> Result<(), RasterError> {
        match offset.checked_add(length) {
            Some(end) if end <= self.length => Ok(()),
            _ => {
                let what = format!(
                    "{length} bytes at position {offset} are asked for, but the file ends at \
                     {}; it is cut short or damaged: fetch it again",
                    self.length
                );
                Err(RasterError::damaged(&self.path, what))
            }
        }
    }
}

impl Sidecars {
    /// Reads what lies beside a raster file. A file that cannot be read counts as absent.
    fn beside(path: &Path) -> Self {
        let extension = path.extension().and_then(|ext| ext.to_str()).unwrap_or("");
        let mut worlds = vec!["wld".to_owned(), format!("{extension}w")];
        let mut letters = extension.chars();
        if let (Some(first), Some(last)) = (letters.next(), letters.last()) {
            worlds.insert(0, format!("{first}{last}w"));
        }
        let read_any = |extensions: &[String]| {
            extensions.iter().find_map(|ext| {
                [ext.clone(), ext.to_ascii_lowercase(), ext.to_ascii_uppercase()]
                    .iter()
                    .find_map(|variant| small_text(&path.with_extension(variant)))
            })
        };
        let mut aux = path.as_os_str().to_owned();
        aux.push(".aux.xml");
        Sidecars {
            world: read_any(&worlds),
            prj: read_any(&["prj".to_owned()]),
            aux: small_text(Path::new(&aux)),
        }
    }
}

/// A text file that is not longer than [`MAX_SIDECAR_BYTES`].
fn small_text(path: &Path) -> Option<String> {
    let file = File::open(path).ok()?;
    if !file.metadata().ok()?.is_file() {
        return None;
    }
    let mut bytes = Vec::new();
    file.take(MAX_SIDECAR_BYTES + 1).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 <= MAX_SIDECAR_BYTES).then(|| String::from_utf8_lossy(&bytes).into_owned())
}

/// The command that turns any raster GDAL knows into one that is read here.
pub(crate) fn conversion_hint(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
    let stem = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy();
    format!(
        "convert it with: gdal_translate -co TILED=YES -co COMPRESS=DEFLATE \"{name}\" \
         \"{stem}-deflate.tif\""
    )
}
