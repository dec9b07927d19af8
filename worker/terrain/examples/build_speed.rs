//! Time and memory of building a store: `cargo run --release -p terrafarm-terrain
//! --example build_speed -- SIDE FILE.terrain` builds SIDE x SIDE posts of made-up ground
//! in whole metres.

use std::sync::atomic::AtomicBool;
use std::time::Instant;
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};

struct Ground;

impl LayerSource for Ground {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        window.fill(into, |i, j| {
            let mixed = (i ^ j << 32).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 61;
            let (i, j) = (i as i64, j as i64);
            let wave = |n: i64, length: i64| (n % length - length / 2).abs() * 4;
            (wave(i + j / 3, 700) + wave(j - i / 2, 410)) as f32 + mixed as f32
        });
        Ok(())
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let side: u64 = arguments.next().ok_or("how many posts a side?")?.parse()?;
    let path = arguments.next().ok_or("which file?")?;
    let spec = LayerSpec {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [10.0; 2],
        posts: [side, side],
        quantum_m: Some(1.0),
    };
    let start = Instant::now();
    let mut builder = StoreBuilder::create(path.as_ref(), "LOCAL", HeightDatum::Unknown, None)?;
    builder.add_layer(spec, &Ground, &|_, _| (), &AtomicBool::new(false))?;
    let summary = builder.finish(ImportReport::default())?;
    let seconds = start.elapsed().as_secs_f64();
    let posts = (side * side) as f64;
    println!(
        "{} tiles, {:.3} bytes a post, {seconds:.1} s, {:.1} million posts a second",
        summary.tiles,
        summary.bytes as f64 / posts,
        posts / seconds * 1e-6
    );
    if let Ok(status) = std::fs::read_to_string("/proc/self/status") {
        status.lines().filter(|line| line.starts_with("VmHWM")).for_each(|line| println!("{line}"));
    }
    Ok(())
}
