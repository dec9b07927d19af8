//! A terrain from a seed as a store on disk.

use crate::{Synth, SynthError, SynthSpec, synthesize};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use terrafarm_terrain::build::{
    BuildError, LayerSource, LayerSpec, SourceError, StoreBuilder, StoreSummary,
};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};
use terrafarm_terrain::rounding;

/// Share of the work that shaping the land takes; the rest is tiles.
const SHAPING: f32 = 0.4;

/// Why there is no store.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The terrain cannot be made.
    #[error(transparent)]
    Synth(#[from] SynthError),
    /// The store cannot be written.
    #[error(transparent)]
    Build(#[from] BuildError),
}

impl LayerSource for Synth {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        let PostWindow { i0, j0, width, height } = window;
        Ok(Synth::heights(self, i0 as i64, j0 as i64, width, height, into)?)
    }

    fn colors(&self, window: PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        let PostWindow { i0, j0, width, height } = window;
        Ok(Synth::colors(self, i0 as i64, j0 as i64, width, height, into)?)
    }
}

/// Makes a terrain and writes it as a store: heights and photo, in a grid that lies
/// nowhere on Earth, with its south-west corner at (0, 0). `progress` is told the share
/// done, 0 to 1.
///
/// # Errors
/// If the spec is out of range, the disk refuses, or `cancel` became true; nothing is
/// left behind then.
pub fn write_store(
    spec: SynthSpec,
    path: &Path,
    progress: &dyn Fn(f32),
    cancel: &AtomicBool,
) -> Result<StoreSummary, WriteError> {
    spec.check()?;
    let mut builder = StoreBuilder::create(path, "LOCAL", HeightDatum::Unknown, None)?;
    let synth = synthesize(spec, &|share| progress(share * SHAPING), cancel)?;
    let side = |posts: u32| [u64::from(posts); 2];
    let layers = [
        (LayerKind::Height, spec.posts, spec.spacing_m, Some(spec.height_step_m())),
        (LayerKind::Photo, spec.photo_side(), spec.spacing_m / f64::from(spec.photo_scale), None),
    ];
    // A photo has more to paint than a height layer has to compute.
    let mut from = SHAPING;
    for (kind, posts, spacing, quantum_m) in layers {
        let to = if kind == LayerKind::Height { 0.6 } else { 1.0 };
        let layer = LayerSpec {
            kind,
            origin: [0.0; 2],
            spacing: [spacing; 2],
            posts: side(posts),
            quantum_m,
        };
        let show = |done: u64, total: u64| {
            progress(from + (to - from) * (done as f32 / total.max(1) as f32));
        };
        builder.add_layer(layer, &synth, &show, cancel)?;
        from = to;
    }
    let report = ImportReport {
        inputs: vec![format!(
            "procedural: {0} x {0} posts, {1} m apart, seed {2}, heights in steps of {3}",
            spec.posts,
            spec.spacing_m,
            spec.seed,
            rounding::in_words(spec.height_step_m().into())
        )],
        made_by: concat!("terrafarm ", env!("CARGO_PKG_VERSION")).into(),
        ..ImportReport::default()
    };
    Ok(builder.finish(report)?)
}
