//! Writes pictures of a procedural terrain: a shaded map and a view from the air.
//!
//! ```text
//! cargo run --release -p terrafarm-synth --example preview -- FOLDER [SEED [POSTS [SPACING_M [PHOTO_SCALE]]]]
//! ```

use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;
use terrafarm_synth::{Synth, SynthSpec, synthesize};

/// Heights and photo of a terrain, whole.
struct Scene {
    heights: Vec<f32>,
    colors: Vec<[u8; 4]>,
    side: usize,
    photo_side: usize,
    spec: SynthSpec,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(args.first().ok_or("give a folder for the pictures")?);
    let number = |place: usize, default: f64| {
        args.get(place).map_or(Ok(default), |text| text.parse::<f64>())
    };
    let spec = SynthSpec {
        seed: number(1, 1.0)? as u64,
        posts: number(2, 2049.0)? as u32,
        spacing_m: number(3, 16.0)?,
        photo_scale: number(4, 1.0)? as u32,
    };
    let start = Instant::now();
    let synth = synthesize(spec, &|_| (), &AtomicBool::new(false))?;
    eprintln!("macro map {:.2} s", start.elapsed().as_secs_f64());
    let heights = synth.all_heights();
    eprintln!("heights {:.2} s", start.elapsed().as_secs_f64());
    let colors = all_colors(&synth);
    eprintln!("photo {:.2} s", start.elapsed().as_secs_f64());
    let scene = Scene {
        heights,
        colors,
        side: spec.posts as usize,
        photo_side: spec.photo_side() as usize,
        spec,
    };
    std::fs::create_dir_all(folder)?;
    let name = |what: &str| folder.join(format!("{what}-{}.png", spec.seed));
    write(&name("map"), &scene.map(1024), 1024, 1024)?;
    let size = spec.extent_m() as f32;
    let views = [
        ("view-n", [0.5, 0.04], 0.0f32, 500.0),
        ("view-e", [0.1, 0.45], 80.0, 700.0),
        ("view-w", [0.85, 0.7], 235.0, 400.0),
    ];
    for (what, [x, y], heading, above) in views {
        let eye = [x * size, y * size];
        let z = scene.height(eye[0], eye[1]) + above;
        let picture = scene.view([eye[0], eye[1], z], heading, -8.0, 1280, 720);
        write(&name(what), &picture, 1280, 720)?;
    }
    if let Some(crop) = args.get(5) {
        let (x, y) = crop.split_once(',').ok_or("crop is X,Y in photo pixels")?;
        let picture = scene.crop(x.parse()?, y.parse()?, 1000);
        write(&name("crop"), &picture, 1000, 1000)?;
    }
    if let Some(camera) = args.get(6) {
        let n: Vec<f32> = camera.split(',').map(str::parse).collect::<Result<_, _>>()?;
        let picture = scene.view([n[0], n[1], n[2]], n[3], n[4], 1280, 720);
        write(&name("camera"), &picture, 1280, 720)?;
    }
    Ok(())
}

fn all_colors(synth: &Synth) -> Vec<[u8; 4]> {
    let side = synth.spec().photo_side() as usize;
    let mut colors = vec![[0; 4]; side * side];
    let band = 64;
    colors.par_chunks_mut(side * band).enumerate().for_each(|(k, pixels)| {
        let rows = pixels.len() / side;
        synth.colors(0, (k * band) as i64, side, rows, pixels).expect("the window fits its buffer");
    });
    colors
}

impl Scene {
    fn height(&self, x: f32, y: f32) -> f32 {
        let last = (self.side - 1) as f32;
        let step = self.spec.spacing_m as f32;
        let (u, v) = ((x / step).clamp(0.0, last - 0.01), (y / step).clamp(0.0, last - 0.01));
        let (i, j) = (u as usize, v as usize);
        let (fx, fy) = (u - i as f32, v - j as f32);
        let at = |i: usize, j: usize| self.heights[j * self.side + i];
        let south = at(i, j) + (at(i + 1, j) - at(i, j)) * fx;
        let north = at(i, j + 1) + (at(i + 1, j + 1) - at(i, j + 1)) * fx;
        south + (north - south) * fy
    }

    /// Colour of the ground in the light of a sun in the south-west.
    fn lit(&self, x: f32, y: f32) -> [f32; 3] {
        let step = self.spec.spacing_m as f32;
        let pixel = step / self.spec.photo_scale as f32;
        let last = self.photo_side - 1;
        let (i, j) = (((x / pixel) as usize).min(last), ((y / pixel) as usize).min(last));
        let color = self.colors[j * self.photo_side + i];
        let gx = (self.height(x + step, y) - self.height(x - step, y)) / (2.0 * step);
        let gy = (self.height(x, y + step) - self.height(x, y - step)) / (2.0 * step);
        let sun = [-0.62, -0.35, 0.70];
        let dot = (-gx * sun[0] - gy * sun[1] + sun[2]) / (1.0 + gx * gx + gy * gy).sqrt();
        let light = 0.36 + 0.92 * dot.max(0.0);
        [0, 1, 2].map(|k| f32::from(color[k]) * light)
    }

    fn map(&self, side: usize) -> Vec<u8> {
        let size = self.spec.extent_m() as f32;
        let rows = (0..side).into_par_iter().flat_map_iter(|row| {
            (0..side).flat_map(move |column| {
                let x = (column as f32 + 0.5) / side as f32 * size;
                let y = (side as f32 - row as f32 - 0.5) / side as f32 * size;
                self.lit(x, y).map(|c| c.min(255.0) as u8)
            })
        });
        rows.collect()
    }

    fn crop(&self, x: usize, y: usize, side: usize) -> Vec<u8> {
        let last = self.photo_side - 1;
        let pixels = (0..side * side).flat_map(|k| {
            let (i, j) = ((x + k % side).min(last), (y + side - 1 - k / side).min(last));
            let color = self.colors[j * self.photo_side + i];
            [color[0], color[1], color[2]]
        });
        pixels.collect()
    }

    /// What a camera sees: each column of pixels marches away from the eye and paints
    /// what rises above all before it.
    fn view(
        &self,
        eye: [f32; 3],
        heading: f32,
        pitch: f32,
        width: usize,
        height: usize,
    ) -> Vec<u8> {
        let focal = 0.85 * width as f32;
        let horizon = height as f32 / 2.0 + focal * pitch.to_radians().tan();
        let (sin, cos) = heading.to_radians().sin_cos();
        let size = self.spec.extent_m() as f32;
        let columns: Vec<Vec<[u8; 3]>> = (0..width)
            .into_par_iter()
            .map(|column| {
                let across = (column as f32 + 0.5 - width as f32 / 2.0) / focal;
                let (dx, dy) = (sin + across * cos, cos - across * sin);
                let mut pixels = vec![[0; 3]; height];
                let mut top = height;
                let mut distance = 20.0f32;
                while distance < 60_000.0 && top > 0 {
                    let (x, y) = (eye[0] + dx * distance, eye[1] + dy * distance);
                    if x < 0.0 || y < 0.0 || x > size || y > size {
                        break;
                    }
                    let rise = (self.height(x, y) - eye[2]) / distance * focal;
                    let row = (horizon - rise).clamp(0.0, height as f32) as usize;
                    if row < top {
                        let fade = 1.0 - 1.0 / (1.0 + distance / 52_000.0);
                        let color = self.lit(x, y);
                        let haze = [176.0, 196.0, 220.0];
                        let seen = [0, 1, 2].map(|k| color[k] + (haze[k] - color[k]) * fade);
                        pixels[row..top].fill(seen.map(|c| c.min(255.0) as u8));
                        top = row;
                    }
                    distance += (distance * 0.0011).max(2.0);
                }
                for (row, pixel) in pixels[..top].iter_mut().enumerate() {
                    let t = row as f32 / height as f32;
                    *pixel =
                        [110.0 + 90.0 * t, 150.0 + 60.0 * t, 205.0 + 25.0 * t].map(|c| c as u8);
                }
                pixels
            })
            .collect();
        (0..height).flat_map(|row| columns.iter().flat_map(move |c| c[row])).collect()
    }
}

fn write(path: &Path, pixels: &[u8], width: u32, height: u32) -> Result<(), std::io::Error> {
    let file = std::io::BufWriter::new(std::fs::File::create(path)?);
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    Ok(())
}
