//! The terrains of the bench as stores on disk.
//!
//! All are windows of one endless noise, with the same post in the middle: the ground
//! around a camera there is the same in each, and a larger one has more land beyond.

use crate::commands::bench::land::{height_layer, noise};
use crate::progress;
use anyhow::{Context, bail};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, PostWindow};
use terrafarm_terrain::store::StoreReader;

/// Distance between posts, metres.
pub const SPACING_M: f64 = 10.0;
/// The post of the noise, along x and y, that is in the middle of every terrain.
const MIDDLE: u64 = 1 << 20;
/// What a post takes on disk, all levels, bytes: measured, and a tenth more.
const BYTES_PER_POST: f64 = 1.2;

/// A square of the noise.
struct Window {
    first: u64,
}

impl LayerSource for Window {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        for (j, row) in (window.j0..).zip(into.chunks_mut(window.width.max(1))) {
            noise::row(self.first + window.i0, self.first + j, row);
        }
        Ok(())
    }
}

/// A terrain on disk.
pub struct Made {
    /// Posts along a side.
    pub posts: u32,
    /// It.
    pub store: StoreReader,
    /// Time that it took to make, seconds; none if it was there.
    pub built_s: Option<f64>,
}

/// The highest ground within so many posts of the middle east, west, north and south,
/// metres.
pub fn highest_in_the_middle(reach: u64) -> f64 {
    let mut highest = f32::NEG_INFINITY;
    let mut row = vec![0.0; 2 * reach as usize + 1];
    for j in MIDDLE - reach..=MIDDLE + reach {
        noise::row(MIDDLE - reach, j, &mut row);
        highest = row.iter().copied().fold(highest, f32::max);
    }
    f64::from(highest)
}

/// Opens the terrains that a folder has and makes the others, smallest first.
pub fn all(folder: &Path, sizes: &[u32]) -> anyhow::Result<Vec<Made>> {
    let place = |posts: u32| folder.join(format!("noise-{posts}.terrain"));
    let missing: Vec<u32> =
        sizes.iter().copied().filter(|&posts| opened(&place(posts), posts).is_none()).collect();
    check_room(folder, &missing)?;
    let mut all = Vec::new();
    for &posts in sizes {
        let built_s = missing.contains(&posts).then(|| make(&place(posts), posts)).transpose()?;
        let path = place(posts);
        let store = opened(&path, posts)
            .with_context(|| format!("{} is not what was written", path.display()))?;
        all.push(Made { posts, store, built_s });
    }
    Ok(all)
}

/// The terrain of a size, if it is there.
fn opened(path: &Path, posts: u32) -> Option<StoreReader> {
    let store = StoreReader::open(path).ok()?;
    (store.index().report.inputs == [says(posts)]).then_some(store)
}

/// What a store says about how it was made. It is another if this text is.
fn says(posts: u32) -> String {
    format!("value noise around post {MIDDLE}: {posts} x {posts} posts, {SPACING_M} m apart")
}

/// Says what the terrains take on disk and refuses if there is no room for them.
fn check_room(folder: &Path, sizes: &[u32]) -> anyhow::Result<()> {
    if sizes.is_empty() {
        return Ok(());
    }
    let posts: f64 = sizes.iter().map(|&posts| f64::from(posts) * f64::from(posts)).sum();
    let need = posts * BYTES_PER_POST;
    let mebibytes = |bytes: f64| (bytes / f64::from(1 << 20)).ceil();
    let free = free_bytes(folder);
    let free_text = match free {
        Some(free) => format!(", {} MiB are free", mebibytes(free)),
        None => String::new(),
    };
    eprintln!(
        "terrafarm: {} terrains are to be made; they take about {} MiB in {}{free_text}",
        sizes.len(),
        mebibytes(need),
        folder.display()
    );
    if free.is_some_and(|free| free < need) {
        bail!(
            "{}: no room for terrains of {} MiB{free_text}; choose another folder with --stores, \
             or smaller terrains with --posts",
            folder.display(),
            mebibytes(need)
        );
    }
    Ok(())
}

/// Bytes that may be written to a folder, where the system tells.
#[cfg(unix)]
fn free_bytes(folder: &Path) -> Option<f64> {
    let room = rustix::fs::statvfs(folder).ok()?;
    Some(room.f_bavail as f64 * room.f_frsize as f64)
}

#[cfg(not(unix))]
fn free_bytes(_folder: &Path) -> Option<f64> {
    None
}

/// Writes a terrain, in parallel and a strip at a time. Returns the seconds it took.
fn make(path: &Path, posts: u32) -> anyhow::Result<f64> {
    let began = Instant::now();
    let half = u64::from(posts / 2);
    let spec = LayerSpec {
        origin: [-(half as f64) * SPACING_M; 2],
        ..height_layer([SPACING_M; 2], [u64::from(posts); 2], Some(noise::QUANTUM_M))
    };
    let mut builder = StoreBuilder::create(path, "LOCAL", HeightDatum::Unknown, None)?;
    let bar = progress::bar(&format!("{posts} posts"), 0);
    let show = |done: u64, total: u64| {
        bar.set_length(total);
        bar.set_position(done);
    };
    let source = Window { first: MIDDLE - half };
    builder.add_layer(spec, &source, &show, &AtomicBool::new(false))?;
    let report = ImportReport {
        inputs: vec![says(posts)],
        made_by: concat!("terrafarm ", env!("CARGO_PKG_VERSION")).into(),
        ..ImportReport::default()
    };
    let summary = builder.finish(report)?;
    bar.finish_and_clear();
    let seconds = began.elapsed().as_secs_f64();
    eprintln!(
        "terrafarm: made {posts} x {posts} posts in {seconds:.0} s: {} MiB",
        summary.bytes.div_ceil(1 << 20)
    );
    Ok(seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_size_has_the_same_ground_in_the_middle_and_is_made_once() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let sizes = [65, 300];
        let made = all(folder.path(), &sizes)?;
        assert!(made.iter().all(|made| made.built_s.is_some()));
        for [x, y] in [[0.0, 0.0], [-310.0, 170.0], [215.0, -303.0]] {
            let heights =
                made.iter().map(|made| terrafarm_terrain::sample::height_at(&made.store, x, y));
            let heights: Vec<_> = heights.collect::<Result<_, _>>()?;
            assert!(heights[0].is_some() && heights[0] == heights[1], "{heights:?}");
        }
        let again = all(folder.path(), &sizes)?;
        assert!(again.iter().all(|made| made.built_s.is_none()));
        Ok(())
    }

    #[test]
    fn a_store_of_another_kind_is_made_anew() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        std::fs::write(folder.path().join("noise-65.terrain"), "something else")?;
        assert!(all(folder.path(), &[65])?[0].built_s.is_some());
        Ok(())
    }
}
