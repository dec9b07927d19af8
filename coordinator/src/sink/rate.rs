//! Frame rates as fractions.

use super::SinkError;
use std::path::Path;

/// Frames per second as `frames / per`, both above 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Rate {
    pub frames: u32,
    pub per: u32,
}

impl Rate {
    /// The fraction of a rate from 0.001 to 1000 frames a second: television's n / 1.001
    /// exactly, anything else to a thousandth.
    pub fn of(fps: f64, output: &Path) -> Result<Self, SinkError> {
        if !(0.001..=1000.0).contains(&fps) {
            let why = format!("{fps} frames per second is no rate for a video; use 0.001 to 1000");
            return Err(SinkError::output(output, why));
        }
        let whole = fps.round();
        if fps == whole {
            return Ok(Rate { frames: whole as u32, per: 1 });
        }
        let television = (fps * 1.001).round();
        if (television / 1.001 - fps).abs() < 0.001 {
            return Ok(Rate { frames: television as u32 * 1000, per: 1001 });
        }
        Ok(Rate { frames: (fps * 1000.0).round() as u32, per: 1000 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_become_the_fractions_that_players_know() {
        let rate = |fps| Rate::of(fps, Path::new("a.mp4")).map(|r| (r.frames, r.per)).ok();
        assert_eq!(rate(30.0), Some((30, 1)));
        assert_eq!(rate(29.97), Some((30_000, 1001)));
        assert_eq!(rate(23.976), Some((24_000, 1001)));
        assert_eq!(rate(60_000.0 / 1001.0), Some((60_000, 1001)));
        assert_eq!(rate(12.5), Some((12_500, 1000)));
        assert_eq!(rate(0.001), Some((1, 1000)));
        for wrong in [0.0, -5.0, f64::NAN, f64::INFINITY, 1001.0] {
            assert_eq!(rate(wrong), None);
        }
    }
}
