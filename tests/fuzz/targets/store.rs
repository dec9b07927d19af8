//! A store as a file: opened, summed up, and read at a few places.

#![no_main]

use std::cell::OnceCell;
use std::path::{Path, PathBuf};
use terrafarm_terrain::info::summary;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::sample::height_at;
use terrafarm_terrain::store::{HEADER_BYTES, StoreReader, hash_of};

/// First byte of an input whose index gets its length and hash right.
const SEALED: u8 = 1;
const HEADER: usize = HEADER_BYTES as usize;

terrafarm_fuzz::target!(seeds(), accepts);

thread_local! {
    static FOLDER: OnceCell<tempfile::TempDir> = const { OnceCell::new() };
}

fn seeds() -> Vec<Vec<u8>> {
    let stores = terrafarm_fuzz::stores::small();
    let with = |first: u8| stores.iter().map(move |store| [&[first], &store[..]].concat());
    with(SEALED).chain(with(0)).collect()
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, bytes)) = input.split_first() else { return false };
    let mut bytes = bytes.to_vec();
    if first & SEALED != 0 {
        seal(&mut bytes);
    }
    let path = file();
    std::fs::write(&path, &bytes).expect("the temporary file can be written");
    is_readable(&path)
}

fn file() -> PathBuf {
    FOLDER.with(|folder| {
        let folder = folder.get_or_init(|| tempfile::tempdir().expect("a temporary folder"));
        folder.path().join("a.terrain")
    })
}

fn is_readable(path: &Path) -> bool {
    let Ok(store) = StoreReader::open(path) else { return false };
    let info = summary(&store);
    assert_eq!(info.layers.len(), store.index().layers.len());
    for (number, layer) in store.index().layers.iter().enumerate() {
        for (level, grid) in layer.levels.iter().enumerate() {
            let (layer, level) = (number as u16, level as u16);
            let [columns, rows] = grid.tiles;
            let _ = store.read_tile(TileKey { layer, level, tx: 0, ty: 0 });
            let _ = store.read_tile(TileKey { layer, level, tx: columns - 1, ty: rows - 1 });
            assert!(store.read_tile(TileKey { layer, level, tx: columns, ty: 0 }).is_err());
        }
    }
    let middle = [0, 1].map(|axis| 0.5 * (info.min[axis] + info.max[axis]));
    for [x, y] in [info.min, info.max, middle, [f64::NAN, f64::INFINITY]] {
        let _ = height_at(&store, x, y);
    }
    true
}

/// Sets length and hash of the index right; its place stays as the input says.
fn seal(bytes: &mut [u8]) {
    let Some((header, rest)) = bytes.split_first_chunk_mut::<HEADER>() else { return };
    let offset = u64::from_le_bytes(*header[16..].first_chunk().expect("a header"));
    let start = usize::try_from(offset).ok().and_then(|offset| offset.checked_sub(HEADER));
    let Some(index) = start.and_then(|start| rest.get(start..)) else { return };
    header[24..32].copy_from_slice(&(index.len() as u64).to_le_bytes());
    header[32..].copy_from_slice(&hash_of(index).0);
}
