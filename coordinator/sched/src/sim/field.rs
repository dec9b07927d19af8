//! What the columns of made-up frames cost: hills that pass through the picture.

use super::SimConfig;
use crate::rng::Rng;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::region::Region;

/// Distance between the hills' control values, in shares of the picture's width.
const HILL: f64 = 1.0 / 6.0;
/// How far the hills move from frame to frame, in shares of the picture's width.
const DRIFT: f64 = 0.004;
/// Frames over which the level of the costs changes.
const LEVEL_FRAMES: f64 = 60.0;
/// Frames between two cuts of the film, where frames differ much.
const CUT_FRAMES: u32 = 40;
/// Width of the sample columns, pixels.
const STEP_PX: u32 = 8;

/// The cost of every pixel of every frame, microseconds at speed 1.
#[derive(Debug, Clone)]
pub(crate) struct Field {
    seed: u64,
    width: u32,
    height: u32,
    skew: f64,
    frame_skew: f64,
    px_us: f64,
}

impl Field {
    /// A field with frames of this size, as the settings want it.
    pub(crate) fn new(seed: u64, (width, height): (u32, u32), config: &SimConfig) -> Self {
        let SimConfig { skew, frame_skew, .. } = *config;
        let area = f64::from(width.max(1)) * f64::from(height.max(1));
        // Noise is 0.5 on average, so that this makes the mean factor 1.
        let mean = (1.0 + 0.5 * skew) * (1.0 + 0.5 * frame_skew);
        let px_us = config.frame_work_s * 1e6 / area / mean;
        Field { seed, width, height, skew, frame_skew, px_us }
    }

    /// Cost of a region, microseconds at speed 1: the same however it is cut.
    pub(crate) fn cost_us(&self, frame: FrameIndex, region: Region) -> f64 {
        let scene = f64::from(frame / CUT_FRAMES);
        let level = (0.7 + 0.6 * self.noise(1, f64::from(frame) / LEVEL_FRAMES))
            * (1.0 + self.frame_skew * self.noise(3, scene));
        let mut columns = 0.0;
        let mut x = region.x;
        while x < region.x + region.width {
            let next = (x / STEP_PX + 1) * STEP_PX;
            let right = next.min(region.x + region.width);
            let middle = f64::from(x / STEP_PX * STEP_PX) + 0.5 * f64::from(STEP_PX);
            let place = middle / f64::from(self.width) / HILL + f64::from(frame) * DRIFT / HILL;
            columns += f64::from(right - x) * (1.0 + self.skew * self.noise(2, place));
            x = right;
        }
        // Rows cost from half the mean at the top (the sky) to one and a half at the foot.
        let (top, foot) = (f64::from(region.y), f64::from(region.y + region.height));
        let weight = |y: f64| 0.5 * y + 0.5 * y * y / f64::from(self.height);
        self.px_us * level * columns * (weight(foot) - weight(top))
    }

    /// Smooth noise over a line, 0 to 1, on average 0.5.
    fn noise(&self, layer: u64, at: f64) -> f64 {
        let cell = at.floor();
        let share = at - cell;
        let smooth = share * share * (3.0 - 2.0 * share);
        let value = |cell: f64| {
            let mut rng = Rng::new(self.seed ^ (layer << 56) ^ cell as i64 as u64);
            rng.next() as f64 / u64::MAX as f64
        };
        value(cell) * (1.0 - smooth) + value(cell + 1.0) * smooth
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrafarm_common::region::{columns, tiles};

    fn of_a_second(frame_skew: f64) -> SimConfig {
        SimConfig { frame_work_s: 1.0, skew: 4.0, frame_skew, ..SimConfig::default() }
    }

    #[test]
    fn a_frame_costs_the_same_however_it_is_cut() {
        let field = Field::new(3, (500, 300), &of_a_second(9.0));
        let whole = field.cost_us(7, Region::whole(500, 300));
        let cuts = [columns(500, 300, &[8, 48, 133, 400]), tiles(500, 300, 37)];
        for cut in cuts {
            let sum: f64 = cut.into_iter().map(|region| field.cost_us(7, region)).sum();
            assert!((sum / whole - 1.0).abs() < 1e-9, "{sum} {whole}");
        }
    }

    #[test]
    fn frames_cost_about_what_was_asked_for_and_columns_differ() {
        let field = Field::new(5, (1920, 1080), &of_a_second(0.0));
        let mean =
            (0..2000).map(|f| field.cost_us(f, Region::whole(1920, 1080))).sum::<f64>() / 2e3;
        assert!((0.7e6..1.3e6).contains(&mean), "{mean}");
        let strips = (0..240).map(|i| Region { x: i * 8, y: 0, width: 8, height: 1080 });
        let costs: Vec<f64> = strips.map(|strip| field.cost_us(0, strip)).collect();
        let (least, most) =
            costs.iter().fold((f64::MAX, 0.0f64), |(a, b), &c| (a.min(c), b.max(c)));
        assert!(most > 1.5 * least, "{least} {most}");
    }

    #[test]
    fn frames_differ_from_scene_to_scene_and_still_cost_what_was_asked_for() {
        let field = Field::new(5, (1920, 1080), &of_a_second(9.0));
        let cost = |frame| field.cost_us(frame, Region::whole(1920, 1080));
        let costs: Vec<f64> = (0..200).map(|scene| cost(scene * CUT_FRAMES)).collect();
        let mean = costs.iter().sum::<f64>() / 200.0;
        assert!((0.7e6..1.3e6).contains(&mean), "{mean}");
        let (least, most) =
            costs.iter().fold((f64::MAX, 0.0f64), |(a, b), &c| (a.min(c), b.max(c)));
        assert!(most > 5.0 * least, "{least} {most}");
    }
}
