//! Shading at every width against the one lane, and against the same in f64.

use super::*;
use crate::lanes::One;
use crate::path::{Ground, Path};
use crate::tests_support::{Plan, keys, mountains, noise, resident, store};
use glam::DVec2;
use terrafarm_common::shading::{Earth, Haze, Sky, Sun};
use terrafarm_terrain::layout::{Layer, TILE_CELLS};
use terrafarm_terrain::resident::Lookup;

const CORNER: [f64; 2] = [562_000.0, 5_117_000.0];
const SIZE: (u32, u32) = (170, 96);

fn light(sun: &Sun, slopes: [f32; 2]) -> f32 {
    let mut out = [0.0];
    let slopes = slopes.map(Floats::splat);
    Sunlight::new(sun).light::<One>(slopes, steepness::<One>(slopes)).store(&mut out);
    out[0]
}

#[test]
fn flat_ground_keeps_the_brightness_of_the_photo() {
    for elevation in [5.0, 30.0, 90.0] {
        let sun = Sun::at(130.0, elevation, 0.25, 0.8);
        assert!((light(&sun, [0.0, 0.0]) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn light_fades_to_the_ambient_share_when_the_sun_sets() {
    let at = |elevation| light(&Sun::at(90.0, elevation, 0.2, 1.0), [0.0, 0.0]);
    assert_eq!(at(-1.0), 0.2);
    assert!((at(0.01) - 0.2).abs() < 0.01);
    let sun = Sun::at(90.0, 10.0, 0.2, 1.0);
    assert!(light(&sun, [-0.5, 0.0]) > 1.0 && light(&sun, [0.5, 0.0]) < 0.5);
}

/// Hills, a finer inset, and two photos, the upper one with a soft edge.
fn plans() -> Vec<Plan> {
    let height = |i: u64, j: u64| (800.0 + mountains(i, j, 128, 300.0, 7)).round();
    let inset = [CORNER[0] + 1500.0, CORNER[1] + 1500.0];
    let photo = |i: u64, j: u64| {
        let green = 0.3 + 0.25 * noise(i / 2, j / 2, 12);
        [0.5 * green, green, 0.3 * green, 1.0]
    };
    let patch = |i: u64, j: u64| {
        let coverage = (i.min(99 - i).min(j.min(99 - j)) as f32 / 20.0).min(1.0);
        [0.8 * coverage, 0.1 * coverage, 0.2 * coverage * (i % 2) as f32, coverage]
    };
    vec![
        Plan::heights(CORNER, [20.0; 2], [560, 540], height),
        Plan::heights(inset, [5.0; 2], [200, 200], move |i, j| height(75 + i / 4, 75 + j / 4)),
        Plan::photo(CORNER, [10.0; 2], [900, 1000], photo),
        Plan::photo([CORNER[0] + 1000.0, CORNER[1] + 900.0], [7.0, 9.0], [100; 2], patch),
    ]
}

fn view(above: f64, heading: f64, pitch: f64, roll: f64) -> View {
    let eye = DVec3::new(CORNER[0] + 900.3, CORNER[1] + 700.7, above);
    View {
        camera: Camera::from_angles(eye, heading, pitch, roll, 60.0, SIZE),
        shading: Shading {
            sun: Some(Sun::at(55.0, 10.0, 0.25, 0.8)),
            haze: Some(Haze {
                visibility_m: 20_000.0,
                scale_height_m: 1500.0,
                color: [0.6, 0.7, 0.8],
            }),
            sky: Sky::default(),
            earth: Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
            below_ground: [0.0; 3],
            bare_ground: None,
        },
        quality: Default::default(),
    }
}

fn views() -> Vec<View> {
    let mut views: Vec<View> =
        [(1300.0, 40.0, -8.0, 5.0), (2500.0, 130.0, -35.0, 0.0), (3000.0, 40.0, -90.0, 0.0)]
            .map(|(above, heading, pitch, roll)| view(above, heading, pitch, roll))
            .into();
    let mut plain = views[0].clone();
    plain.shading = Shading {
        sun: None,
        haze: None,
        earth: None,
        bare_ground: Some([0.5; 3]),
        ..plain.shading
    };
    views.push(plain);
    views[1].shading.haze.as_mut().expect("there is haze").scale_height_m = 0.0;
    views
}

/// Distances along the map: of the ground for most pixels, now and then the sky, a missing
/// tile, or a place close by or far off.
fn distances(resident: &Resident, pyramid: &Pyramid, view: &View) -> Vec<f32> {
    let all = Region::whole(SIZE.0, SIZE.1);
    let mut distances = vec![f32::INFINITY; all.area() as usize];
    let traced = crate::trace(resident, pyramid, view, all, |x, y, hit| {
        let at = (y * SIZE.0 + x) as usize;
        if let Some(hit) = hit {
            let away = (hit.position - view.camera.position).truncate();
            distances[at] = match at % 101 {
                3 => f32::NAN,
                7 => f32::INFINITY,
                _ => away.length() as f32,
            };
        }
    });
    traced.expect("all tiles are loaded");
    distances
}

fn shaded(shader: &mut Shader, distances: &[f32]) -> [Vec<f32>; 3] {
    let at = |n: usize| (n as u32 % SIZE.0, n as u32 / SIZE.0);
    let x: Vec<f32> = (0..distances.len()).map(|n| at(n).0 as f32 + 0.5).collect();
    let y: Vec<f32> = (0..distances.len()).map(|n| at(n).1 as f32 + 0.5).collect();
    let mut light = [0, 1, 2].map(|_| vec![9.0; distances.len()]);
    let [red, green, blue] = &mut light;
    let places = Places { at: At::Each(&x, &y), far: Far::Map(distances) };
    shader.shade(places, [red, green, blue]);
    light
}

#[test]
fn all_widths_and_all_runs_give_the_same_bits() {
    let resident = resident(plans());
    let pyramid = Pyramid::new(resident.index());
    for view in views() {
        let distances = distances(&resident, &pyramid, &view);
        let field = Field { resident: &resident, pyramid: &pyramid };
        let bits = |light: &[Vec<f32>; 3]| -> Vec<u32> {
            light.iter().flatten().map(|light| light.to_bits()).collect()
        };
        let mut shader = Shader::new(field, &view.camera, &view.shading, 1);
        shader.width = Width::One;
        let expected = shaded(&mut shader, &distances);
        for width in Width::available() {
            let mut shader = Shader::new(field, &view.camera, &view.shading, 1);
            shader.width = width;
            assert!(bits(&shaded(&mut shader, &distances)) == bits(&expected), "{}", width.name());
        }
        // Place by place, in any order.
        let mut shader = Shader::new(field, &view.camera, &view.shading, 1);
        for n in (0..distances.len()).rev().step_by(37) {
            let (x, y) = (n as u32 % SIZE.0, n as u32 / SIZE.0);
            let at = At::Each(&[x as f32 + 0.5], &[y as f32 + 0.5]);
            let places = Places { at, far: Far::Map(&distances[n..=n]) };
            let mut one = [[0.0f32]; 3];
            let [red, green, blue] = &mut one;
            shader.shade(places, [red, green, blue]);
            for c in 0..3 {
                assert_eq!(one[c][0].to_bits(), expected[c][n].to_bits());
            }
        }
    }
}

#[test]
fn places_without_ground_or_tiles_are_told_apart() {
    let (resident, tiles) = store(plans());
    let pyramid = Pyramid::new(resident.index());
    let field = Field { resident: &resident, pyramid: &pyramid };
    let view = view(2500.0, 130.0, -35.0, 0.0);
    let mut shader = Shader::new(field, &view.camera, &view.shading, 1);
    let light = shaded(&mut shader, &[f32::INFINITY, f32::NAN, 1000.0, 2000.0]);
    assert!(light.iter().all(|light| light[0].is_finite() && light[1].is_nan()));
    assert!(light.iter().all(|light| light[2].is_nan() && light[3].is_nan()));
    let mut missing = BTreeSet::new();
    shader.wanted.drain_into(&mut missing);
    let kinds = |kind| {
        missing.iter().any(|key| resident.index().layers[usize::from(key.layer)].kind == kind)
    };
    assert!(kinds(LayerKind::Height) && kinds(LayerKind::Photo), "{missing:?}");
    let known: Vec<TileKey> = tiles.iter().map(|(key, _)| *key).collect();
    assert!(missing.iter().all(|key| known.contains(key)));
    assert!(missing.len() < keys(resident.index()).len());
}

/// The same in f64, place by place.
struct Slow<'a> {
    resident: &'a Resident,
    view: &'a View,
    lowest: f64,
}

impl Slow<'_> {
    fn light(&self, x: f64, y: f64, s: f64) -> [f64; 3] {
        let Shading { haze, earth, sun, bare_ground, .. } = &self.view.shading;
        let camera = &self.view.camera;
        let ray = camera.ray(x, y).normalize();
        let level = ray.truncate().length().max(1e-6);
        let u = s / level;
        let ground = Ground::new(*earth);
        let z0 = camera.position.z;
        let z = z0 + ground.rise(z0, level * level * u * u, ray.z * u);
        let distance = Path::new(ground, camera.position, ray).distance(u, z);
        let place = camera.position.truncate() + ray.truncate() * u;
        let size = distance * ray.dot(camera.forward) / camera.focal_px();
        let slopes = self.slopes(place, size);
        let normal = DVec3::new(-slopes.x, -slopes.y, 1.0);
        let view = ray + DVec3::Z * (level * s * ground.curvature());
        let facing = view.dot(normal).min(-normal.length() / 64.0);
        let sides = [camera.right, camera.up]
            .map(|side| (side * size - view * (side.dot(normal) * size / facing)).truncate());
        let mut sum = [0.0; 4];
        let layers = &self.resident.index().layers;
        for (number, layer) in layers.iter().enumerate().rev() {
            if layer.kind == LayerKind::Photo && sum[3] < f64::from(0.999f32) {
                let below = self.photo(number, layer, place, sides);
                let uncovered = 1.0 - sum[3];
                (0..4).for_each(|c| sum[c] += uncovered * below[c]);
            }
        }
        let bare = bare_ground.unwrap_or_else(|| {
            let slopes = [slopes.x, slopes.y].map(|slope| Floats::splat(slope as f32));
            tint::tint::<One>(Floats::splat(z as f32), slopes).map(|channel| {
                let mut out = [0.0];
                channel.store(&mut out);
                out[0]
            })
        });
        let lit = sun.map_or(1.0, |sun| {
            let [ambient, strength] = [sun.ambient, sun.strength].map(f64::from);
            let l = sun.direction;
            let direct = normal.dot(l).max(0.0) / (normal.length() * l.z.max(0.05));
            1.0 + strength * ((ambient + (1.0 - ambient) * direct).min(2.0) - 1.0)
        });
        let seen = [0, 1, 2].map(|c| (sum[c] + (1.0 - sum[3]) * f64::from(bare[c])) * lit);
        let Some(haze) = haze else { return seen };
        let (mean, above) = if haze.scale_height_m > 0.0 {
            let x = (z - z0) / haze.scale_height_m;
            ((1.0 - libm::exp(-x)) / x, (z0 - self.lowest) / haze.scale_height_m)
        } else {
            (1.0, 0.0)
        };
        let extinction = 3.912 / haze.visibility_m * libm::exp(-above);
        let clear = libm::exp(-extinction * distance * mean);
        let glow = sun.map_or(0.0, |sun| {
            let away = 1.0 - ray.dot(sun.direction);
            0.35 / (1.0 + 900.0 * away) + 0.08 / (1.0 + 15.0 * away)
        });
        [0, 1, 2].map(|c| {
            let air = f64::from(haze.color[c]) + glow * [1.0, 0.93, 0.80][c];
            seen[c] * clear + air * (1.0 - clear)
        })
    }

    fn slopes(&self, place: DVec2, size: f64) -> DVec2 {
        let layers = &self.resident.index().layers;
        let mut heights =
            layers.iter().enumerate().filter(|(_, l)| l.kind == LayerKind::Height).rev();
        let (number, layer) = heights
            .find(|(number, layer)| *number == 0 || inside(layer, place, 0.01))
            .expect("there is a layer");
        let spacing = layer.spacing[0].max(layer.spacing[1]);
        mixed(size / spacing, layer, |level| {
            let [p, q] = posts(layer, place, level);
            let (i, j) = (p.floor(), q.floor());
            let h = |di: f64, dj: f64| self.height(number, level, (i + di) as i64, (j + dj) as i64);
            let size = layer.level_posts(level).map(|posts| (posts - 1) as f64);
            // From the post before to the one after; beside the layer's border, one-sided.
            let ends = |at: f64, d: f64, size: f64| {
                let (before, after) = ((at + d - 1.0).max(0.0), (at + d + 1.0).min(size));
                [before - at, after - at, 2.0 / (after - before).max(1.0)]
            };
            let (x, y) = (p - i, q - j);
            let blend = |slope: &dyn Fn(f64, f64) -> f64| {
                let south = slope(0.0, 0.0) * (1.0 - x) + slope(1.0, 0.0) * x;
                let north = slope(0.0, 1.0) * (1.0 - x) + slope(1.0, 1.0) * x;
                south * (1.0 - y) + north * y
            };
            let step = f64::from(1u32 << level);
            [
                blend(&|di, dj| {
                    let [before, after, scale] = ends(i, di, size[0]);
                    (h(after, dj) - h(before, dj)) * scale
                }) / (2.0 * step * layer.spacing[0]),
                blend(&|di, dj| {
                    let [before, after, scale] = ends(j, dj, size[1]);
                    (h(di, after) - h(di, before)) * scale
                }) / (2.0 * step * layer.spacing[1]),
            ]
        })
        .into()
    }

    fn photo(&self, number: usize, layer: &Layer, place: DVec2, sides: [DVec2; 2]) -> [f64; 4] {
        if !inside(layer, place, 0.5) {
            return [0.0; 4];
        }
        let [a, b] = sides.map(|side| side / DVec2::from(layer.spacing));
        let (xx, yy, xy) = (a.x * a.x + b.x * b.x, a.y * a.y + b.y * b.y, a.x * b.y - a.y * b.x);
        let (half, area) = (0.5 * (xx - yy), xy.abs());
        let cross = a.x * a.y + b.x * b.y;
        let root = half.hypot(cross);
        let major = (0.5 * (xx + yy) + root).sqrt();
        let along_x = half >= 0.0;
        let slant = cross / (half.abs() + root);
        let length = major / (1.0 + slant * slant).sqrt();
        mixed((area / major).max(major / 16.0), layer, |level| {
            let [p, q] = posts(layer, place, level);
            let (middle, across) = if along_x { (p, q) } else { (q, p) };
            let length = (length / f64::from(1u32 << level)).clamp(1.0, 64.0);
            let (start, stop) = (middle - 0.5 * length, middle + 0.5 * length);
            let mut sum = [0.0; 4];
            for texel in (start + 0.5).floor() as i64..(stop + 0.5).ceil() as i64 {
                let at = texel as f64;
                let weight = (stop - at + 0.5).min(at + 0.5 - start).min(1.0) / length;
                let side = across + (at - middle) * slant;
                let part = side - side.floor();
                for (beside, share) in [(0.0, 1.0 - part), (1.0, part)] {
                    let other = (side.floor() + beside) as i64;
                    let (i, j) = if along_x { (texel, other) } else { (other, texel) };
                    let color = self.texel(number, level, i, j);
                    (0..4).for_each(|c| sum[c] += weight * share * color[c]);
                }
            }
            sum
        })
    }

    fn height(&self, number: usize, level: usize, i: i64, j: i64) -> f64 {
        let (key, i, j) = self.find(number, level, i, j);
        match self.resident.height(key) {
            Lookup::Found(tile) => f64::from(tile.post(i, j)),
            _ => panic!("{key:?} is not there"),
        }
    }

    fn texel(&self, number: usize, level: usize, i: i64, j: i64) -> [f64; 4] {
        let (key, i, j) = self.find(number, level, i, j);
        let Lookup::Found(tile) = self.resident.photo(key) else { return [0.0; 4] };
        let texels = tile.texels();
        let at = (j + 1) as usize * terrafarm_terrain::layout::TILE_POSTS + (i + 1) as usize;
        let light = |field: u32| {
            let root = f64::from(texels.light[at] & field) / f64::from(field);
            root * root
        };
        let [red, green, blue] = terrafarm_terrain::tile::FIELDS.map(light);
        [red, green, blue, texels.coverage.map_or(1.0, |all| f64::from(all[at]) / 65535.0)]
    }

    /// The tile of a post, or of the nearest one of the layer, and its place in it.
    fn find(&self, number: usize, level: usize, i: i64, j: i64) -> (TileKey, isize, isize) {
        let layer = &self.resident.index().layers[number];
        let size = layer.level_posts(level);
        let at = [0, 1].map(|axis| [i, j][axis].clamp(0, size[axis] as i64 - 1));
        let last = layer.levels[level].tiles;
        let tile = [0, 1].map(|axis| (at[axis] as u32 / TILE_CELLS as u32).min(last[axis] - 1));
        let within = |axis: usize| (at[axis] - i64::from(tile[axis]) * TILE_CELLS as i64) as isize;
        let key = TileKey { layer: number as u16, level: level as u16, tx: tile[0], ty: tile[1] };
        (key, within(0), within(1))
    }
}

fn inside(layer: &Layer, place: DVec2, margin: f64) -> bool {
    (0..2).all(|axis| {
        let at = (place[axis] - layer.origin[axis]) / layer.spacing[axis];
        -margin <= at && at < (layer.posts[axis] - 1) as f64 + margin
    })
}

fn posts(layer: &Layer, place: DVec2, level: usize) -> [f64; 2] {
    [0, 1].map(|axis| {
        let at = (place[axis] - layer.origin[axis]) / layer.spacing[axis];
        at.clamp(0.0, (layer.posts[axis] - 1) as f64) / f64::from(1u32 << level)
    })
}

/// Blends two levels.
fn mixed<const N: usize>(size: f64, layer: &Layer, at: impl Fn(usize) -> [f64; N]) -> [f64; N] {
    let top = layer.levels.len() - 1;
    let size = size.max(1.0);
    let level = (libm::log2(size).floor() as usize).min(top);
    let way = size / f64::from(1u32 << level) - 1.0;
    let share = if level == top { 0.0 } else { (2.0 * way - 0.5).clamp(0.0, 1.0) };
    let (fine, coarse) = (at(level), if share > 0.0 { at(level + 1) } else { at(level) });
    std::array::from_fn(|n| fine[n] + (coarse[n] - fine[n]) * share)
}

/// The most that light may be off; a byte is 1/255.
const TOLERANCE: f64 = 2e-4;

#[test]
fn light_is_that_of_the_same_formulas_in_f64() {
    let resident = resident(plans());
    let pyramid = Pyramid::new(resident.index());
    for view in views() {
        let distances = distances(&resident, &pyramid, &view);
        let field = Field { resident: &resident, pyramid: &pyramid };
        let mut shader = Shader::new(field, &view.camera, &view.shading, 1);
        let light = shaded(&mut shader, &distances);
        let slow = Slow { resident: &resident, view: &view, lowest: pyramid.lowest() };
        let (mut worst, mut compared) = (0.0f64, 0);
        for (n, &s) in distances.iter().enumerate().filter(|(_, s)| s.is_finite()) {
            let (x, y) = (n as u32 % SIZE.0, n as u32 / SIZE.0);
            let expected = slow.light(f64::from(x) + 0.5, f64::from(y) + 0.5, f64::from(s));
            let off = |c: usize| (f64::from(light[c][n]) - expected[c]).abs();
            let off = off(0).max(off(1)).max(off(2));
            assert!(off < TOLERANCE, "{x} {y}: off by {off} from {expected:?}");
            worst = worst.max(off);
            compared += 1;
        }
        println!("{compared} places, off by at most {worst:.1e}");
        assert!(compared > 2000);
    }
}
