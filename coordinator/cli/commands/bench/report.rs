//! Numbers to tables and files.

use anyhow::Context;
use serde::Serialize;
use std::path::Path;
use terrafarm_common::quality::Method;

/// The value below or at which a share of the values lies (nearest rank); 0 of none. NaN
/// counts as larger than everything.
pub fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let rank = (share * values.len() as f64).ceil() as usize;
    values.get(rank.clamp(1, values.len().max(1)) - 1).copied().unwrap_or(0.0)
}

/// The middle of some values; 0 of none.
pub fn median(values: &mut [f64]) -> f64 {
    quantile(values, 0.5)
}

/// Median, 99th percentile and maximum of errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Half of the errors are at most this.
    pub p50: f64,
    /// 99 of 100 are.
    pub p99: f64,
    /// All are.
    pub max: f64,
}

impl Spread {
    /// The spread of some errors; all 0 of none.
    pub fn of(mut errors: Vec<f64>) -> Self {
        let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| quantile(&mut errors, share));
        Spread { p50, p99, max }
    }
}

/// What a method promises of its error: which figure of the spread, and its bound, pixels.
pub struct Promise {
    /// `p99` or `max`.
    pub figure: &'static str,
    /// The largest value that keeps the promise.
    pub bound_px: f64,
}

impl Promise {
    /// How far from the surface an answer of `Exact` may be for rounding, pixels.
    pub const ROUNDING_PX: f64 = 0.01;

    /// What the historical baseline is held to within its envelope: it reads no tolerance.
    /// It takes the columns of a pitched picture for vertical planes, which was measured to
    /// be off by up to 12.5 pixels over hills at 10 degrees, and by more in wider views.
    pub const VOXEL_PX: f64 = 16.0;

    /// What a method promises at a tolerance.
    pub fn of(method: Method, tolerance_px: f64) -> Self {
        match method {
            Method::Exact | Method::Frustum | Method::Reference => {
                Promise { figure: "max", bound_px: Self::ROUNDING_PX }
            }
            Method::Voxel => Promise { figure: "p99", bound_px: Self::VOXEL_PX },
            _ => Promise { figure: "p99", bound_px: tolerance_px },
        }
    }

    /// The figure that is promised.
    pub fn value(&self, spread: &Spread) -> f64 {
        if self.figure == "max" { spread.max } else { spread.p99 }
    }

    /// Whether a spread keeps it. NaN does not.
    pub fn holds(&self, spread: &Spread) -> bool {
        self.value(spread) <= self.bound_px
    }
}

/// Lines of a table: the first column to the left, the others to the right.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let mut widths: Vec<usize> = head.iter().map(|cell| cell.chars().count()).collect();
    for row in rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let line = |cells: &mut dyn Iterator<Item = &str>| {
        let mut text = String::new();
        for (column, (cell, width)) in cells.zip(&widths).enumerate() {
            match column {
                0 => text.push_str(&format!("{cell:width$}")),
                _ => text.push_str(&format!("  {cell:>width$}")),
            }
        }
        text.trim_end().to_owned() + "\n"
    };
    let mut text = line(&mut head.iter().copied());
    for row in rows {
        text.push_str(&line(&mut row.iter().map(String::as_str)));
    }
    text
}

/// Three digits that matter, without an exponent.
pub fn digits(value: f64) -> String {
    match value.abs() {
        _ if !value.is_finite() => value.to_string(),
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        size if size >= 0.1 || size == 0.0 => format!("{value:.2}"),
        size if size >= 0.001 => format!("{value:.4}"),
        _ => format!("{value:.1e}"),
    }
}

/// Writes a report as JSON, if a file for it was named.
pub fn save(path: Option<&Path>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let text = serde_json::to_string_pretty(report).context("cannot write the report as JSON")?;
    std::fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_of_the_list_and_nan_is_the_largest() {
        let mut values = [3.0, 1.0, 2.0, 4.0];
        assert_eq!(median(&mut values), 2.0);
        assert_eq!(quantile(&mut values, 0.99), 4.0);
        assert_eq!(quantile(&mut [], 0.5), 0.0);
        let spread = Spread::of(vec![1.0, f64::NAN]);
        assert!(spread.max.is_nan());
        assert!(!Promise::of(Method::Exact, 1.0).holds(&spread));
    }

    #[test]
    fn exact_promises_its_maximum_and_lod_its_tolerance() {
        let spread = Spread { p50: 0.0, p99: 0.4, max: 3.0 };
        assert!(!Promise::of(Method::Exact, 0.5).holds(&spread));
        assert!(Promise::of(Method::Lod, 0.5).holds(&spread));
        assert!(!Promise::of(Method::Lod, 0.3).holds(&spread));
    }

    #[test]
    fn a_table_aligns_its_columns() {
        let rows = [vec!["lod".into(), digits(12.345)], vec!["exact".into(), digits(0.5)]];
        assert_eq!(table(&["method", "ms"], &rows), "method    ms\nlod     12.3\nexact   0.50\n");
    }
}
