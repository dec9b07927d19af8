//! Small statistics for reports.

/// The value below which a share of the sorted samples lies, by nearest rank.
/// `None` for no samples. `share` is clamped to 0..=1.
pub fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let rank = (share.clamp(0.0, 1.0) * last as f64).round() as usize;
    Some(sorted[rank.min(last)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_a_short_list() {
        let list = [1.0, 2.0, 3.0, 4.0, 5.0];
        assert_eq!(quantile(&list, 0.5), Some(3.0));
        assert_eq!(quantile(&list, 1.0), Some(5.0));
        assert_eq!(quantile(&list, 0.0), Some(1.0));
        assert_eq!(quantile(&[], 0.5), None);
    }
}
