//! The ground at a place: the macro map enlarged, with detail that fits what is there.

use crate::SynthSpec;
use crate::grid::Sample;
use crate::landscape::Landscape;
use crate::noise::{Noise, mix, smoothstep};

/// The longest wavelength of added detail, cells of the macro map.
const DETAIL_CELLS: f32 = 4.5;
/// The shortest, posts.
const DETAIL_POSTS: f32 = 2.2;
const MAX_OCTAVES: usize = 12;

/// What is known of the ground at a post.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ground {
    /// Height of the surface, metres: of the water where there is a lake.
    pub height: f32,
    /// Depth of the lake, metres; 0 on land.
    pub depth: f32,
    /// Where this lies on the macro map, cells.
    pub u: f64,
    pub v: f64,
}

/// The terrain as a function of place.
pub(crate) struct Surface {
    pub landscape: Landscape,
    pub seed: u64,
    pub spacing_m: f64,
    height_step_m: f32,
    wavelengths_m: Vec<f32>,
    warp: Noise,
    ribs: Noise,
    rough: Noise,
}

impl Surface {
    /// The surface of a landscape, with detail down to the posts of the spec.
    pub fn new(spec: &SynthSpec, landscape: Landscape) -> Surface {
        let mut wavelengths_m = vec![];
        let mut wavelength = DETAIL_CELLS * landscape.cell_m;
        while wavelength > DETAIL_POSTS * spec.spacing_m as f32 && wavelengths_m.len() < MAX_OCTAVES
        {
            wavelengths_m.push(wavelength);
            wavelength *= 0.53;
        }
        Surface {
            landscape,
            seed: spec.seed,
            spacing_m: spec.spacing_m,
            height_step_m: spec.height_step_m(),
            wavelengths_m,
            warp: Noise::new(spec.seed, 20),
            ribs: Noise::new(spec.seed, 21),
            rough: Noise::new(spec.seed, 22),
        }
    }

    /// The ground at a post. Posts outside the terrain continue its border.
    pub fn post(&self, i: i64, j: i64) -> Ground {
        let (x, y) = (i as f64 * self.spacing_m, j as f64 * self.spacing_m);
        let cell = f64::from(self.landscape.cell_m);
        let (cx, cy) = (x / cell, y / cell);
        let shift = |a: f64, b: f64| {
            let wide = self.warp.at(cx * 0.083 + a, cy * 0.083 + b);
            let fine = self.warp.at(cx * 0.29 + b, cy * 0.29 + a);
            f64::from(1.7 * wide + 0.5 * fine)
        };
        let (u, v) = (cx + shift(0.0, 0.5), cy + shift(91.7, 13.1));
        let sample = self.landscape.heights.spline(u, v);
        let level = self.landscape.level.at((u + 0.5).floor() as i64, (v + 0.5).floor() as i64);
        let calm = self.calm(sample.value, level, u, v);
        let height = sample.value + self.detail(&sample, x, y, u, v, calm);
        let in_steps =
            |height: f32| (height / self.height_step_m + 0.5).floor() * self.height_step_m;
        if height < level {
            return Ground { height: in_steps(level), depth: level - height, u, v };
        }
        Ground { height: in_steps(height), depth: 0.0, u, v }
    }

    /// How much of the detail a place may have: none at shores and in river beds.
    fn calm(&self, height: f32, level: f32, u: f64, v: f64) -> f32 {
        let shore = smoothstep(0.0, 30.0, height - level);
        match self.landscape.rivers.nearest(u as f32, v as f32) {
            None => shore,
            Some((across, reach)) => {
                let half = 0.5 * reach.bed_m / self.landscape.cell_m;
                shore * smoothstep(0.6 * half, half + 1.2, across.abs())
            }
        }
    }

    /// Height of the detail at a place, metres.
    fn detail(&self, macro_sample: &Sample, x: f64, y: f64, u: f64, v: f64, calm: f32) -> f32 {
        let landscape = &self.landscape;
        let mut slope_x = macro_sample.slope_x / landscape.cell_m;
        let mut slope_y = macro_sample.slope_y / landscape.cell_m;
        let floor = landscape.floor.bilinear(u, v).clamp(0.0, 1.0);
        let wild = calm * (1.0 - floor);
        let mut sum = 0.0;
        for (octave, &wavelength) in self.wavelengths_m.iter().enumerate() {
            let scale = 1.0 / f64::from(wavelength);
            let shift = octave as f64 * 7.7;
            let (px, py) = (x * scale + shift, y * scale - shift);
            let slope = (slope_x * slope_x + slope_y * slope_y).sqrt();
            let steep = wild * smoothstep(0.12, 0.75, slope);
            if steep > 0.0 {
                let (down_x, down_y) = (-slope_x / slope, -slope_y / slope);
                let (wave, tilt) = self.ribs.gullies(px, py, down_x, down_y);
                let strength = 0.062 * steep;
                sum += strength * wavelength * wave;
                slope_x -= strength * tilt * down_y;
                slope_y += strength * tilt * down_x;
            }
            let rough = mix(0.0035 * (0.15 + 0.85 * calm), 0.045, steep);
            sum += rough * wavelength * self.rough.at(px * 1.3, py * 1.3);
        }
        sum
    }
}
