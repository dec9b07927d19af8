//! Heights as 16-bit multiples of a step: which step fits, and whether one does.
//!
//! The steps that are tried are those in which heights come: whole metres and binary
//! fractions of them (whole numbers, and everything that terrafarm itself rounds),
//! decimals, feet. A step is taken only if every post comes back bit for bit.

use super::VOID;

/// The finest binary step: 2^-10 m.
const FINEST_BINARY: i32 = 10;
/// Other steps, metres, in the order in which they are tried: decimals, feet, survey feet
/// and their tenths.
const OTHER_STEPS_M: [f64; 8] =
    [0.1, 0.05, 0.01, 0.001, 0.3048, 1200.0 / 3937.0, 0.03048, 120.0 / 3937.0];
/// The largest code of a valid height; 0 stands below all of them, [`VOID`] above.
const MAX_CODE: f64 = (VOID - 1) as f64;
/// Posts that a step is tried on before all are.
const PROBES: usize = 32;

/// Posts as codes, and what the codes mean.
pub(super) struct Coded {
    pub(super) posts: Box<[u16]>,
    pub(super) base: i32,
    pub(super) step: f64,
}

/// Height of a code that is not [`VOID`], metres.
#[inline(always)]
pub(super) fn height(base: i32, step: f64, code: u16) -> f32 {
    (f64::from(base + i32::from(code)) * step) as f32
}

/// Codes for posts (NaN for voids), and one more, a void, as a pad. `None` if no step
/// gives every post back within 65 534 codes.
pub(super) fn coded(posts: &[f32]) -> Option<Coded> {
    let valid = || posts.iter().copied().filter(|post| !post.is_nan());
    let (low, high) = valid().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), post| {
        (if post < low { post } else { low }, if post > high { post } else { high })
    });
    if low > high {
        return Some(Coded { posts: vec![VOID; posts.len() + 1].into(), base: 0, step: 1.0 });
    }
    let stride = (posts.len() / PROBES).max(1);
    let probes = || posts.iter().copied().step_by(stride).filter(|post| !post.is_nan());
    binary_step(probes())
        .and_then(|_| binary_step(valid()))
        .into_iter()
        .chain(OTHER_STEPS_M)
        .find_map(|step| {
            let base = base_of(low, high, step)?;
            let fits = probes().all(|post| code_of(post, base, step).is_some());
            if fits { in_steps(posts, base, step) } else { None }
        })
}

/// The coarsest step from 1 m to 2^-10 m that divides all heights.
fn binary_step(heights: impl Iterator<Item = f32>) -> Option<f64> {
    let finest = f64::from(1u32 << FINEST_BINARY);
    let mut bits = 1i64 << FINEST_BINARY;
    for height in heights {
        let steps = f64::from(height) * finest;
        let whole = steps as i64;
        if whole as f64 != steps {
            return None;
        }
        bits |= whole;
    }
    Some(f64::from(1u32 << bits.trailing_zeros()) / finest)
}

/// One step below the lowest height; `None` if codes cannot reach from there to the
/// highest, or whole steps would not fit an i32.
fn base_of(low: f32, high: f32, step: f64) -> Option<i32> {
    let base = (f64::from(low) / step).round() - 1.0;
    let within = f64::from(i32::MIN) <= base && base <= f64::from(i32::MAX - i32::from(VOID));
    let reaches = f64::from(high) / step - base <= MAX_CODE + 0.5;
    (within && reaches).then_some(base as i32)
}

/// The code of a height, if it gives the height back bit for bit.
#[inline]
fn code_of(post: f32, base: i32, step: f64) -> Option<u16> {
    // Above 0 a cast rounds down. The quotient is never far from a whole number where
    // there is a code, so how it is rounded decides nothing.
    let code = (f64::from(post) / step - f64::from(base) + 0.5) as u16;
    let same = height(base, step, code).to_bits() == post.to_bits();
    ((1..VOID).contains(&code) && same).then_some(code)
}

fn in_steps(posts: &[f32], base: i32, step: f64) -> Option<Coded> {
    let mut codes = Vec::with_capacity(posts.len() + 1);
    for &post in posts {
        codes.push(if post.is_nan() { VOID } else { code_of(post, base, step)? });
    }
    codes.push(VOID);
    Some(Coded { posts: codes.into_boxed_slice(), base, step })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn step_of(posts: &[f32]) -> Option<f64> {
        coded(posts).map(|coded| coded.step)
    }

    #[test]
    fn the_coarsest_binary_step_that_fits_is_taken() {
        assert_eq!(step_of(&[4.0, 8.0, -12.0]), Some(1.0));
        assert_eq!(step_of(&[0.0, 0.0]), Some(1.0));
        assert_eq!(step_of(&[0.5, 8.0]), Some(0.5));
        assert_eq!(step_of(&[1.0 / 1024.0, 8.0]), Some(1.0 / 1024.0));
        assert_eq!(step_of(&[1.0 / 2048.0, 8.0]), None);
    }

    #[test]
    fn decimals_and_feet_are_found() {
        for step in [0.1, 0.05, 0.01, 0.001, 0.3048, 1200.0 / 3937.0, 0.03048, 120.0 / 3937.0] {
            let posts: Vec<f32> =
                (-300..700).map(|n| (f64::from(n * 37 + 1) * step) as f32).collect();
            assert_eq!(step_of(&posts), Some(step));
        }
    }

    #[test]
    fn all_65534_codes_are_used_and_no_more() {
        let range = |steps: u16| [-7.25f32, -7.25 + f32::from(steps) / 4.0];
        let widest = coded(&range(65_533)).unwrap();
        assert_eq!((widest.step, &*widest.posts), (0.25, &[1, 65_534, VOID][..]));
        assert!(coded(&range(65_534)).is_none());
        assert!(coded(&[0.0, 65_534.0]).is_none());
    }

    #[test]
    fn whole_steps_beyond_an_i32_are_left_alone() {
        assert_eq!(step_of(&[2e9, 2e9]), Some(1.0));
        assert_eq!(step_of(&[2f32.powi(31); 2]), None);
        assert_eq!(step_of(&[-2f32.powi(31); 2]), None, "one below it would not fit");
        assert_eq!(step_of(&[2f32.powi(53); 2]), None);
        assert_eq!(step_of(&[f32::INFINITY, 0.0]), None);
        assert_eq!(step_of(&[f32::MAX, f32::MIN]), None);
    }

    #[test]
    fn a_negative_zero_has_no_code() {
        assert_eq!(step_of(&[-0.0, 1.0]), None);
    }
}
