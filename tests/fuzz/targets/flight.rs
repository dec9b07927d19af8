//! Flight files. What is read can be flown, and every camera on the way is sound.

#![no_main]

use input::flight::{Bounds, Place};
use std::path::Path;

#[allow(dead_code, reason = "what the program reads besides")]
#[path = "../../../coordinator/cli/input/mod.rs"]
mod input;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let flights = [
        "t,lon,lat,height,heading,pitch\n0,5,4,900,30,-10\n1.5,5.1,4.1,950,40,-12\n",
        "\"time\";easting;northing;agl;yaw;tilt;roll;fov;heading_ref\r\n\
         0;5000,5;4000;80;350;-10;5;60;grid\r\n2;5100;4000;80;10;-10;;;true\r\n\
         2;100;4000;80;10;-10;;90;true\r\n3;100;4100;80;10;-10;-5;;\r\n",
        "# heading: grid\n\nt\tx\ty\tz\theading\tpitch\n0\t5\t6\t7\t8\t9\n1\t6\t6\t7\t8\t9\n4\t7\t7\t7\t7\t7\n",
    ];
    flights.map(|text| text.as_bytes().to_vec()).to_vec()
}

fn accepts(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let Ok(file) = input::flight::parse(Path::new("f.csv"), text, &Slope, 60.0) else {
        return false;
    };
    let flight = file.flight;
    let (start, duration) = (flight.start_s(), flight.duration_s());
    assert!(duration >= 0.0);
    for part in [-0.1, 0.0, 0.1, 0.25, 0.5, 0.77, 1.0, 1.1] {
        let pose = flight.pose_at(start + part * duration);
        assert!(pose.camera((640, 360)).is_valid(), "{pose:?} at {part} of the way");
    }
    if let Ok(times) = flight.frame_times(24.0) {
        assert!(times.take(100).all(|time| (start..=flight.end_s()).contains(&time)));
    }
    true
}

/// A square of 10 km where a degree is 1000 m and the ground slopes up to a void.
struct Slope;

impl Place for Slope {
    fn to_grid(&self, lon: f64, lat: f64) -> Result<[f64; 2], String> {
        if lat > 80.0 { Err("too far north".into()) } else { Ok([lon * 1000.0, lat * 1000.0]) }
    }

    fn convergence_deg(&self, _: f64, _: f64) -> f64 {
        2.0
    }

    fn ground(&self, x: f64, _: f64) -> Option<f64> {
        (0.0..9000.0).contains(&x).then_some(x / 10.0)
    }

    fn bounds(&self) -> Bounds {
        Bounds { min: [0.0; 2], max: [10_000.0; 2] }
    }
}
