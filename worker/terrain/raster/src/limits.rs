//! Every limit that a declared size is checked against before memory is asked for.

/// The largest number of samples along a side of a raster: 2^26, as of a store.
pub const MAX_SIDE: u64 = 1 << 26;
/// The largest number of samples of a format that has to be held whole (PNG, JPEG,
/// USGS DEM): 2^28, a square of 16 384; at most 1 GiB in memory.
pub const MAX_WHOLE_SAMPLES: u64 = 1 << 28;
/// The longest file of a format that is read into memory before decoding.
pub const MAX_WHOLE_FILE_BYTES: u64 = 1 << 30;
/// The largest decoded strip or tile of a TIFF, bytes. As heights or colours it takes up
/// to four times as much.
pub const MAX_CHUNK_BYTES: u64 = 1 << 28;
/// The largest number of strips or tiles of a TIFF.
pub const MAX_CHUNKS: u64 = 1 << 24;
/// The longest text or key tag of a TIFF, bytes.
pub const MAX_TAG_BYTES: u64 = 1 << 22;
/// The largest number of directories of a TIFF that are looked at.
pub const MAX_DIRECTORIES: usize = 1 << 10;
/// The largest number of entries of one TIFF directory.
pub const MAX_ENTRIES: u64 = 1 << 12;
/// The longest world file, .prj or .aux.xml, bytes.
pub const MAX_SIDECAR_BYTES: u64 = 1 << 20;
/// The largest number of files in a zipped SRTM tile.
pub const MAX_ZIP_ENTRIES: usize = 64;
