//! Stores for tests, from rules of column and row.

use crate::build::{BuildError, LayerSource, LayerSpec, SourceError, StoreBuilder, StoreSummary};
use crate::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};
use std::path::Path;
use std::sync::atomic::AtomicBool;

type HeightRule = Box<dyn Fn(u64, u64) -> f32 + Sync>;
type ColorRule = Box<dyn Fn(u64, u64) -> [u8; 4] + Sync>;

/// Rolling ground in whole metres.
pub(crate) fn hills(i: u64, j: u64) -> f32 {
    (100.0 + 40.0 * libm::sin(i as f64 / 9.0) + 30.0 * libm::cos(j as f64 / 7.0)).round() as f32
}

/// A layer of heights in whole metres, 10 m apart, from the origin.
pub(crate) fn height_layer(posts: [u64; 2]) -> LayerSpec {
    LayerSpec {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [10.0; 2],
        posts,
        quantum_m: Some(1.0),
    }
}

enum Rule {
    Heights(HeightRule),
    Colors(ColorRule),
}

impl LayerSource for Rule {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        let Rule::Heights(rule) = self else { return Err("colours".into()) };
        assert_eq!(into.len(), window.area());
        window.fill(into, rule);
        Ok(())
    }

    fn colors(&self, window: PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        let Rule::Colors(rule) = self else { return Err("heights".into()) };
        assert_eq!(into.len(), window.area());
        window.fill(into, rule);
        Ok(())
    }
}

/// A store to be built.
#[derive(Default)]
pub(crate) struct Ground {
    layers: Vec<(LayerSpec, Rule)>,
}

impl Ground {
    pub(crate) fn new() -> Self {
        Ground::default()
    }

    pub(crate) fn heights(
        mut self,
        spec: LayerSpec,
        rule: impl Fn(u64, u64) -> f32 + Sync + 'static,
    ) -> Self {
        self.layers.push((spec, Rule::Heights(Box::new(rule))));
        self
    }

    pub(crate) fn colors(
        mut self,
        spec: LayerSpec,
        rule: impl Fn(u64, u64) -> [u8; 4] + Sync + 'static,
    ) -> Self {
        let spec = LayerSpec { kind: LayerKind::Photo, quantum_m: None, ..spec };
        self.layers.push((spec, Rule::Colors(Box::new(rule))));
        self
    }

    pub(crate) fn build(&self, path: &Path) -> Result<StoreSummary, BuildError> {
        let mut builder = StoreBuilder::create(path, "LOCAL", HeightDatum::Unknown, None)?;
        for (spec, rule) in &self.layers {
            builder.add_layer(*spec, rule, &|_, _| (), &AtomicBool::new(false))?;
        }
        builder.finish(ImportReport::default())
    }
}
