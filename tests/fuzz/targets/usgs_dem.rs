//! USGS DEM.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let padded = dem();
    let lines = padded.chunks(1024).map(|line| String::from_utf8_lossy(line).trim_end().to_owned());
    let trimmed = lines.collect::<Vec<_>>().join("\n").into_bytes();
    vec![padded, trimmed]
}

/// Two profiles of three posts.
fn dem() -> Vec<u8> {
    let mut record = vec![b' '; 1024];
    let fields = [
        (0, "TEST QUADRANGLE"),
        (144, "     1     1     1    10"),
        (528, "     2     2"),
        (816, "  30.0000000  30.0000000   0.1000000"),
        (852, "     1     2"),
        (890, " 4"),
    ];
    for (at, text) in fields {
        record[at..at + text.len()].copy_from_slice(text.as_bytes());
    }
    let double = |value: f64| format!("{:>24}", format!("{value:.15e}").replace('e', "D"));
    for column in 1..=2 {
        let mut profile = format!("     1{column:6}     3     1");
        profile += &double(500_000.0 + 30.0 * f64::from(column));
        profile += &[5_100_000.0, 10.0, 0.0, 0.0].map(double).concat();
        profile += "   100-32767   300";
        record.extend(format!("{profile:1024}").bytes());
    }
    record
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("a.dem", input.to_vec(), Sidecars::default()))
}
