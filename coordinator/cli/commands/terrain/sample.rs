//! `terrafarm terrain sample`: CSV in, CSV out with a last column `height_m`.

use anyhow::{Context, bail};
use std::fs;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::Path;
use terrafarm_geo::Crs;
use terrafarm_terrain::sample::Sampler;
use terrafarm_terrain::store::StoreReader;

/// Longest line of the CSV, bytes.
const LINE_MAX: u64 = 64 << 10;

/// Which columns hold the position, and in what.
enum Columns {
    /// Metres of the store's reference system.
    Grid(usize, usize),
    /// Degrees.
    LonLat(usize, usize),
}

/// Prints every line of the CSV with the height at its point behind it.
pub fn run(store: &Path, points: &Path) -> anyhow::Result<()> {
    let reader = StoreReader::open(store)?;
    let crs = Crs::parse(&reader.index().crs)?;
    let mut sampler = Sampler::new(&reader);
    let input: Box<dyn Read> = if points == Path::new("-") {
        Box::new(io::stdin().lock())
    } else {
        let file = fs::File::open(points);
        Box::new(file.with_context(|| format!("cannot open {}", points.display()))?)
    };
    let mut input = BufReader::new(input);
    let mut output = BufWriter::new(io::stdout().lock());
    let name = points.display();
    let header = next_line(&mut input).with_context(|| format!("{name}, line 1"))?;
    let Some(header) = header else { bail!("{name} is empty; its first line names the columns") };
    let columns = find_columns(&header).with_context(|| format!("{name}, line 1"))?;
    writeln!(output, "{header},height_m")?;
    let mut number = 1;
    while let Some(line) =
        next_line(&mut input).with_context(|| format!("{name}, line {}", number + 1))?
    {
        number += 1;
        if line.trim().is_empty() {
            continue;
        }
        let [x, y] =
            position(&line, &columns, &crs).with_context(|| format!("{name}, line {number}"))?;
        match sampler.height_at(x, y)? {
            // f64 prints the shortest digits that read back the same.
            Some(height) => writeln!(output, "{line},{height}")?,
            None => writeln!(output, "{line},")?,
        }
    }
    output.flush()?;
    Ok(())
}

fn next_line(input: &mut impl BufRead) -> anyhow::Result<Option<String>> {
    let mut bytes = Vec::new();
    let length = input.by_ref().take(LINE_MAX).read_until(b'\n', &mut bytes)?;
    if length as u64 == LINE_MAX {
        bail!("the line is longer than {LINE_MAX} bytes; is this a CSV of points?");
    }
    if length == 0 {
        return Ok(None);
    }
    let text = String::from_utf8(bytes).context("not text in UTF-8")?;
    Ok(Some(text.trim_start_matches('\u{feff}').trim_end_matches(['\r', '\n']).to_owned()))
}

fn find_columns(header: &str) -> anyhow::Result<Columns> {
    let names: Vec<_> = header.split(',').map(|name| name.trim().to_ascii_lowercase()).collect();
    let find = |wanted: &[&str]| names.iter().position(|name| wanted.contains(&name.as_str()));
    match (find(&["lon", "longitude"]), find(&["lat", "latitude"]), find(&["x"]), find(&["y"])) {
        (Some(lon), Some(lat), _, _) => Ok(Columns::LonLat(lon, lat)),
        (_, _, Some(x), Some(y)) => Ok(Columns::Grid(x, y)),
        _ => bail!("no columns lon,lat or x,y in \"{header}\""),
    }
}

fn position(line: &str, columns: &Columns, crs: &Crs) -> anyhow::Result<[f64; 2]> {
    let fields: Vec<_> = line.split(',').collect();
    let number = |column: usize| -> anyhow::Result<f64> {
        let Some(field) = fields.get(column) else {
            bail!("has {} columns, the position is in column {}", fields.len(), column + 1)
        };
        match field.trim().parse() {
            Ok(value) if f64::is_finite(value) => Ok(value),
            _ => bail!("\"{}\" in column {} is not a number", field.trim(), column + 1),
        }
    };
    match *columns {
        Columns::Grid(x, y) => Ok([number(x)?, number(y)?]),
        Columns::LonLat(lon, lat) => Ok(crs.from_lonlat([number(lon)?, number(lat)?])?),
    }
}
