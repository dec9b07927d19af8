//! `terrafarm compare`: how far two pictures, or two sequences of pictures, are apart.

mod picture;

use crate::{Outcome, args, progress};
use anyhow::{Context, bail};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use terrafarm_common::accuracy::Spread;
use terrafarm_common::compare::{Comparison, compare, difference, gain_for, psnr_db};
use terrafarm_coordinator::sink::poster;

/// One pair of pictures.
struct Pair {
    /// Its number, if it is of a sequence.
    number: Option<u64>,
    paths: [PathBuf; 2],
    found: Comparison,
}

/// Compares and prints.
pub fn run(args: &args::Compare) -> anyhow::Result<Outcome> {
    let (places, unpaired) = pairs(&args.one, &args.other)?;
    let bar = progress::bar("pictures", places.len() as u64);
    let mut pairs = Vec::with_capacity(places.len());
    for (number, [one, other]) in places {
        let found = compare(&picture::read(&one)?, &picture::read(&other)?);
        let found = found.with_context(|| {
            format!("{} and {} cannot be compared", one.display(), other.display())
        })?;
        pairs.push(Pair { number, paths: [one, other], found });
        bar.inc(1);
    }
    bar.finish_and_clear();
    let Some(worst) = pairs.iter().max_by(|a, b| a.found.mse.total_cmp(&b.found.mse)) else {
        bail!("there is nothing to compare");
    };
    let gain = gain_for(worst.found.difference_max);
    if let Some(path) = &args.difference {
        let [one, other] = &worst.paths;
        let shown = difference(&picture::read(one)?, &picture::read(other)?, gain)?;
        poster::save(path, &shown)?;
    }
    let shown = args.difference.as_deref().map(|path| (path, gain));
    if args.json {
        print_line!("{}", serde_json::to_string_pretty(&report(&pairs, worst, unpaired, shown))?);
    } else {
        print(&pairs, worst, unpaired, shown);
    }
    Ok(Outcome::Done)
}

type Places = Vec<(Option<u64>, [PathBuf; 2])>;

/// The pictures to compare, and how many have no partner.
fn pairs(one: &Path, other: &Path) -> anyhow::Result<(Places, usize)> {
    let (left, right) = match [one, other].map(picture::sequence) {
        [None, None] => return Ok((vec![(None, [one.into(), other.into()])], 0)),
        [Some(left), Some(right)] => (picture::numbered(left)?, picture::numbered(right)?),
        [found, _] => {
            let (folder, file) = if found.is_some() { (one, other) } else { (other, one) };
            let (folder, file) = (folder.display(), file.display());
            bail!("{folder} is a sequence and {file} is not; give two pictures or two folders");
        }
    };
    let total = left.len() + right.len();
    let places: Places = left
        .into_iter()
        .filter_map(|(number, path)| Some((Some(number), [path, right.get(&number)?.clone()])))
        .collect();
    if places.is_empty() {
        let (one, other) = (one.display(), other.display());
        bail!("no picture in {one} has a number that one in {other} has");
    }
    let unpaired = total - 2 * places.len();
    Ok((places, unpaired))
}

fn mean(pairs: &[Pair], of: impl Fn(&Comparison) -> f64) -> f64 {
    pairs.iter().map(|pair| of(&pair.found)).sum::<f64>() / pairs.len() as f64
}

fn print(pairs: &[Pair], worst: &Pair, unpaired: usize, shown: Option<(&Path, u32)>) {
    let psnr = |mse: f64| match psnr_db(mse) {
        db if db.is_finite() => format!("{db:.2} dB"),
        _ => "identical".to_owned(),
    };
    if let Some(number) = worst.number {
        print_line!(
            "{} pictures: mean PSNR {} (of the mean square), mean SSIM {:.5}",
            pairs.len(),
            psnr(mean(pairs, |found| found.mse)),
            mean(pairs, |found| found.ssim)
        );
        if unpaired > 0 {
            print_line!("{unpaired} pictures have no partner of the same number and were left out");
        }
        print_line!("the worst is number {number}:");
    }
    let found = &worst.found;
    print_line!("PSNR        {}   of 8-bit sRGB", psnr(found.mse));
    print_line!("SSIM        {:.5}   of luma, 11 x 11 Gaussian of sigma 1.5", found.ssim);
    match found.silhouette_px {
        Some(Spread { p50, p99, max }) => print_line!(
            "silhouettes p50 {p50:.2}, p99 {p99:.2}, max {max:.2} pixels   between strong edges"
        ),
        None => print_line!("silhouettes none: neither picture has a strong edge"),
    }
    print_line!(
        "channels    p99 {:.2}, max {:.2} of 255",
        found.difference_p99,
        found.difference_max
    );
    if let Some((path, gain)) = shown {
        print_line!("{}: differences times {gain}", path.display());
    }
}

fn report(pairs: &[Pair], worst: &Pair, unpaired: usize, shown: Option<(&Path, u32)>) -> Value {
    let mut report = measures(&worst.found);
    if let Some(number) = worst.number {
        report = json!({
            "pictures": pairs.len(),
            "unpaired": unpaired,
            "mean": {
                "psnr_db": decibels(mean(pairs, |found| found.mse)),
                "ssim": mean(pairs, |found| found.ssim),
                "difference_p99": mean(pairs, |found| found.difference_p99),
            },
            "worst": report,
            "worst_number": number,
        });
    }
    if let Some((path, gain)) = shown {
        report["difference"] = json!({ "path": path, "gain": gain });
    }
    report
}

/// `null` for equal pictures: JSON has no infinity.
fn decibels(mse: f64) -> Value {
    let psnr = psnr_db(mse);
    if psnr.is_finite() { json!(psnr) } else { Value::Null }
}

fn measures(found: &Comparison) -> Value {
    json!({
        "identical": found.mse == 0.0,
        "psnr_db": decibels(found.mse),
        "ssim": found.ssim,
        "silhouette_px": found
            .silhouette_px
            .map(|px| json!({ "p50": px.p50, "p99": px.p99, "max": px.max })),
        "difference_p99": found.difference_p99,
        "difference_max": found.difference_max,
    })
}
