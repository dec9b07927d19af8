//! The aerial photo: what grows, lies or flows at each place, as colour.
//!
//! Each pixel is a stack of covers, each with a share 0..1 that is blended over those
//! before it: meadow, fields, forest, alpine grass, scree, rock, snow, gravel, water. The
//! renderer shades; the photo holds only a touch of what the sky does not reach.

use crate::noise::{Noise, mix, smoothstep};
use crate::surface::{Ground, Surface};

type Color = [f32; 3];

/// Height of the tree line and of the snow line above the lowest valley, metres, for the
/// full relief.
const TREE_LINE_M: f32 = 1230.0;
const SNOW_LINE_M: f32 = 1640.0;
const BASE_M: f32 = 480.0;

/// What decides the colour of a pixel.
struct Site {
    /// Position, metres.
    x: f64,
    y: f64,
    /// Place on the macro map, cells.
    u: f64,
    v: f64,
    height: f32,
    depth: f32,
    /// Slope, metres per metre, and its part towards the north.
    slope: f32,
    slope_y: f32,
    /// Height above the mean of the neighbouring posts, metres per metre.
    bulge: f32,
}

/// Paints a window of the photo.
pub(crate) fn paint(
    surface: &Surface,
    scale: i64,
    (i0, j0): (i64, i64),
    (width, height): (usize, usize),
    into: &mut [[u8; 4]],
) {
    if into.is_empty() {
        return;
    }
    let first = (i0.div_euclid(scale) - 1, j0.div_euclid(scale) - 1);
    let last_i = (i0 + width as i64 - 1).div_euclid(scale) + 3;
    let last_j = (j0 + height as i64 - 1).div_euclid(scale) + 3;
    let (columns, rows) = ((last_i - first.0) as usize, (last_j - first.1) as usize);
    let mut posts = Vec::with_capacity(columns * rows);
    for j in 0..rows {
        posts.extend((0..columns).map(|i| surface.post(first.0 + i as i64, first.1 + j as i64)));
    }
    let palette = Palette::new(surface);
    for (row, pixels) in into.chunks_mut(width).enumerate() {
        let pj = j0 + row as i64;
        let j = (pj.div_euclid(scale) - first.1) as usize;
        let fy = pj.rem_euclid(scale) as f32 / scale as f32;
        for (column, pixel) in pixels.iter_mut().enumerate() {
            let pi = i0 + column as i64;
            let i = (pi.div_euclid(scale) - first.0) as usize;
            let fx = pi.rem_euclid(scale) as f32 / scale as f32;
            let mut site = site_between(&posts, columns, (i, j), (fx, fy), surface.spacing_m);
            site.x = pi as f64 * surface.spacing_m / scale as f64;
            site.y = pj as f64 * surface.spacing_m / scale as f64;
            let color = palette.color(&site, (pi, pj));
            let [red, green, blue] = color.map(|c| (c.clamp(0.0, 255.0) + 0.5) as u8);
            *pixel = [red, green, blue, 255];
        }
    }
}

/// What lies between four posts, the slopes taken from the posts around them.
fn site_between(
    posts: &[Ground],
    columns: usize,
    (i, j): (usize, usize),
    (fx, fy): (f32, f32),
    spacing_m: f64,
) -> Site {
    let at = |di: usize, dj: usize| &posts[(j + dj) * columns + i + di];
    let of = |get: fn(&Ground) -> f32| {
        let south = mix(get(at(0, 0)), get(at(1, 0)), fx);
        let north = mix(get(at(0, 1)), get(at(1, 1)), fx);
        mix(south, north, fy)
    };
    let around = |di: usize, dj: usize| {
        let center = (j + dj) * columns + i + di;
        let height = |offset: isize| posts[center.wrapping_add_signed(offset)].height;
        let span = columns as isize;
        let (west, east, south, north) = (height(-1), height(1), height(-span), height(span));
        let per_m = 1.0 / spacing_m as f32;
        [
            0.5 * (east - west) * per_m,
            0.5 * (north - south) * per_m,
            (height(0) - 0.25 * (west + east + south + north)) * per_m,
        ]
    };
    let corners = [around(0, 0), around(1, 0), around(0, 1), around(1, 1)];
    let [slope_x, slope_y, bulge] = [0, 1, 2].map(|k| {
        let [sw, se, nw, ne] = corners.map(|corner| corner[k]);
        mix(mix(sw, se, fx), mix(nw, ne, fx), fy)
    });
    let place = |get: fn(&Ground) -> f64| {
        let (x, y) = (f64::from(fx), f64::from(fy));
        let south = get(at(0, 0)) + (get(at(1, 0)) - get(at(0, 0))) * x;
        let north = get(at(0, 1)) + (get(at(1, 1)) - get(at(0, 1))) * x;
        south + (north - south) * y
    };
    Site {
        x: 0.0,
        y: 0.0,
        u: place(|ground| ground.u),
        v: place(|ground| ground.v),
        height: of(|ground| ground.height),
        depth: of(|ground| ground.depth),
        slope: (slope_x * slope_x + slope_y * slope_y).sqrt(),
        slope_y,
        bulge,
    }
}

/// The covers of a terrain.
struct Palette<'a> {
    surface: &'a Surface,
    wide: Noise,
    middle: Noise,
    fine: Noise,
    grain: Noise,
    plots: Noise,
    pixel_m: f32,
}

/// Covers a colour with another, by a share.
fn cover(color: &mut Color, with: Color, share: f32) {
    for (below, above) in color.iter_mut().zip(with) {
        *below += (above - *below) * share;
    }
}

fn blend(a: Color, b: Color, share: f32) -> Color {
    [0, 1, 2].map(|k| mix(a[k], b[k], share))
}

/// Everything about a pixel that several covers ask for.
struct Cast {
    wide: f32,
    middle: f32,
    fine: f32,
    grain: f32,
    /// Height above the lowest valley, metres, stretched to the full relief.
    rise: f32,
    floor: f32,
    openness: f32,
}

impl<'a> Palette<'a> {
    fn new(surface: &'a Surface) -> Self {
        let noise = |purpose| Noise::new(surface.seed, purpose);
        Palette {
            surface,
            wide: noise(40),
            middle: noise(41),
            fine: noise(42),
            grain: noise(43),
            plots: noise(44),
            pixel_m: surface.spacing_m as f32,
        }
    }

    fn color(&self, site: &Site, pixel: (i64, i64)) -> Color {
        let land = &self.surface.landscape;
        let (x, y) = (site.x, site.y);
        let grain = self.grain.uniform(pixel.0, pixel.1) - 0.5;
        let cast = Cast {
            wide: self.wide.fbm(x / 1700.0, y / 1700.0, 3),
            middle: self.middle.fbm(x / 260.0, y / 260.0, 3),
            fine: self.fine.fbm(x / 46.0, y / 46.0, 2),
            grain,
            rise: (site.height - BASE_M) / land.relief.max(0.05),
            floor: land.floor.bilinear(site.u, site.v),
            openness: land.openness.bilinear(site.u, site.v),
        };
        let mut color = self.grass(site, &cast);
        self.forest(&mut color, site, &cast);
        self.stone(&mut color, site, &cast);
        self.snow(&mut color, site, &cast);
        self.water(&mut color, site, &cast);
        let hollow = (cast.openness / (-3.0 * land.cell_m)).clamp(-0.35, 0.6);
        let small = (-0.9 * site.bulge).clamp(-0.12, 0.16);
        let sky = 1.0 - 0.22 * hollow - small;
        let sky = if site.depth > 0.0 { 1.0 } else { sky };
        color.map(|c| c * sky)
    }

    /// Meadows and fields below, alpine grass above.
    fn grass(&self, site: &Site, cast: &Cast) -> Color {
        let meadow = blend([92.0, 112.0, 56.0], [124.0, 134.0, 74.0], 0.5 + 0.6 * cast.middle);
        let alpine = blend([112.0, 114.0, 70.0], [142.0, 130.0, 90.0], 0.5 + 0.7 * cast.middle);
        let high = smoothstep(700.0, 1450.0, cast.rise + 150.0 * cast.wide);
        let mut color = blend(meadow, alpine, high);
        let farmed = smoothstep(0.5, 0.9, cast.floor)
            * smoothstep(0.10, 0.04, site.slope)
            * smoothstep(760.0, 560.0, cast.rise + 80.0 * cast.wide);
        if farmed > 0.0 {
            cover(&mut color, self.field(site), 0.85 * farmed);
        }
        let shade = 1.0 + 0.10 * cast.fine + 0.06 * cast.grain;
        color.map(|c| c * shade)
    }

    /// A mosaic of plots: hay, pasture, ripe corn, ploughed earth.
    fn field(&self, site: &Site) -> Color {
        let (x, y) = (site.x / 210.0, site.y / 150.0);
        let (floor_x, floor_y) = (x.floor(), y.floor());
        let (fx, fy) = ((x - floor_x) as f32, (y - floor_y) as f32);
        let mut best = (f32::INFINITY, f32::INFINITY, 0.0);
        for dy in -1i64..=1 {
            for dx in -1i64..=1 {
                let (cx, cy) = (floor_x as i64 + dx, floor_y as i64 + dy);
                let ox = dx as f32 + 0.15 + 0.7 * self.plots.uniform(cx, cy) - fx;
                let oy = dy as f32 + 0.15 + 0.7 * self.plots.uniform(cy, cx) - fy;
                let distance = ox.abs() + oy.abs();
                if distance < best.0 {
                    best = (distance, best.0, self.plots.uniform(cx * 3 + 1, cy * 5 + 2));
                } else if distance < best.1 {
                    best.1 = distance;
                }
            }
        }
        const CROPS: [Color; 6] = [
            [116.0, 136.0, 66.0],
            [138.0, 150.0, 82.0],
            [96.0, 120.0, 54.0],
            [168.0, 158.0, 100.0],
            [126.0, 108.0, 80.0],
            [108.0, 130.0, 62.0],
        ];
        let crop = CROPS[((best.2 * 6.0) as usize).min(5)];
        let hedge = smoothstep(0.10, 0.03, best.1 - best.0);
        blend(crop, [66.0, 82.0, 46.0], 0.7 * hedge)
    }

    /// Forest below a ragged tree line, thin where it is steep, wet or farmed.
    fn forest(&self, color: &mut Color, site: &Site, cast: &Cast) {
        let sunny = (site.slope_y * 0.9).clamp(-0.5, 0.5);
        let line = TREE_LINE_M + 150.0 * cast.wide + 170.0 * cast.middle + 130.0 * sunny;
        let below = smoothstep(70.0, -50.0, cast.rise - line + 60.0 * cast.fine);
        let standing = smoothstep(1.0, 0.72, site.slope + 0.1 * cast.fine);
        // Snow slides keep the gullies free of trees, the more so near the tree line.
        let slides = smoothstep(-0.01, -0.05, site.bulge)
            * smoothstep(0.40, 0.62, site.slope)
            * smoothstep(500.0, 1000.0, cast.rise);
        let valley = smoothstep(0.25, 0.7, cast.floor) * smoothstep(0.20, 0.11, site.slope);
        let grove = smoothstep(0.28, 0.42, cast.middle + 0.25 * cast.wide);
        let pasture = smoothstep(0.18, 0.38, cast.wide - 0.35 * cast.middle)
            * smoothstep(0.62, 0.35, site.slope);
        let cleared = (1.0 - valley * (1.0 - grove)) * (1.0 - 0.95 * pasture);
        let share = below * standing * (1.0 - 0.85 * slides) * cleared;
        if share <= 0.0 {
            return;
        }
        let conifer = blend([34.0, 52.0, 34.0], [46.0, 64.0, 40.0], 0.5 + 0.8 * cast.middle);
        let broadleaf = blend([58.0, 78.0, 40.0], [74.0, 94.0, 50.0], 0.5 + 0.8 * cast.fine);
        let low = smoothstep(520.0, 240.0, cast.rise + 160.0 * cast.wide + 120.0 * cast.middle);
        let crowns = 1.0 + 0.30 * cast.fine + 0.34 * cast.grain;
        let trees = blend(conifer, broadleaf, 0.75 * low).map(|c| c * crowns);
        // Single trees at the edge: the share becomes a chance.
        let edge = smoothstep(0.35, 0.65, share + 0.7 * cast.grain);
        cover(color, trees, mix(share, edge, 0.7));
    }

    /// Scree under cliffs, bare rock where it is steep or high.
    fn stone(&self, color: &mut Color, site: &Site, cast: &Cast) {
        let high = smoothstep(1050.0, 1650.0, cast.rise + 170.0 * cast.wide + 120.0 * cast.middle);
        let steep = site.slope + 0.10 * cast.middle + 0.07 * cast.fine;
        let loose = smoothstep(0.42, 0.66, steep) * high;
        let barren = smoothstep(1500.0, 1850.0, cast.rise + 200.0 * cast.middle);
        let scree_share = (loose.max(0.8 * barren)) * (0.75 + 0.5 * cast.fine).clamp(0.0, 1.0);
        let scree = blend([136.0, 130.0, 120.0], [164.0, 158.0, 148.0], 0.5 + 0.9 * cast.fine);
        cover(color, scree.map(|c| c * (1.0 + 0.10 * cast.grain)), scree_share);
        let limit = mix(1.0, 0.54, high);
        let ribs = smoothstep(0.0, 0.10, site.bulge) * 0.18;
        let share = smoothstep(limit - 0.10, limit + 0.14, steep + ribs);
        if share <= 0.0 {
            return;
        }
        // Beds of rock dip across the map and show as bands on steep ground.
        let bed = site.height * 0.013 + cast.wide * 1.3 + (site.x - 0.6 * site.y) as f32 * 0.0011;
        let band = self.fine.at(f64::from(bed) * 2.3, 0.5 + f64::from(cast.middle) * 0.2);
        let tone = 0.5 + 0.22 * band + 0.40 * cast.fine + 0.25 * cast.middle;
        let gray = blend([84.0, 80.0, 78.0], [138.0, 132.0, 124.0], tone.clamp(0.0, 1.0));
        let warm = blend([96.0, 82.0, 70.0], [150.0, 132.0, 112.0], tone.clamp(0.0, 1.0));
        let rock = blend(gray, warm, smoothstep(-0.1, 0.5, cast.wide));
        cover(color, rock.map(|c| c * (1.0 + 0.14 * cast.grain)), share);
    }

    /// Snow above a line, lower in the shade and in gullies, none on cliffs.
    fn snow(&self, color: &mut Color, site: &Site, cast: &Cast) {
        let sunny = (site.slope_y * 1.1).clamp(-0.8, 0.8);
        let line = SNOW_LINE_M
            + 110.0 * cast.wide
            + 90.0 * cast.middle
            + 190.0 * sunny
            + 900.0 * site.bulge.clamp(-0.18, 0.18);
        let above = smoothstep(-70.0, 110.0, cast.rise - line + 70.0 * cast.fine);
        let hold = mix(0.58, 0.92, smoothstep(0.0, 600.0, cast.rise - line));
        let lies = smoothstep(hold + 0.12, hold - 0.16, site.slope + 0.13 * cast.fine);
        let share = above * lies;
        if share <= 0.0 {
            return;
        }
        let hollow = smoothstep(0.02, -0.06, site.bulge);
        let white = blend([240.0, 243.0, 248.0], [214.0, 225.0, 240.0], 0.6 * hollow);
        let white = white.map(|c| c * (1.0 + 0.02 * cast.fine));
        cover(color, white, share);
    }

    /// Lakes, and rivers in their gravel.
    fn water(&self, color: &mut Color, site: &Site, cast: &Cast) {
        if site.depth > 0.0 {
            let deep = 1.0 - 1.0 / (1.0 + site.depth * 0.16);
            let shallow = [92.0, 132.0, 122.0];
            let lake = blend(shallow, [20.0, 52.0, 66.0], smoothstep(0.0, 0.75, deep));
            cover(color, lake, smoothstep(0.0, 0.6, site.depth));
            return;
        }
        let land = &self.surface.landscape;
        let Some((across, reach)) = land.rivers.nearest(site.u as f32, site.v as f32) else {
            return;
        };
        let snowed = smoothstep(SNOW_LINE_M - 250.0, SNOW_LINE_M - 50.0, cast.rise);
        let across_m = across * land.cell_m;
        let bed_half = 0.5 * reach.bed_m * (0.75 + 0.5 * cast.middle + 0.3 * cast.fine);
        let blur = 0.5 * self.pixel_m;
        let gravel = smoothstep(bed_half + blur, bed_half - blur, across_m.abs());
        let wood = smoothstep(2.4 * bed_half + 20.0, bed_half, across_m.abs()) * cast.floor;
        cover(color, [56.0, 74.0, 42.0], 0.6 * wood * smoothstep(-0.25, 0.2, cast.fine));
        let pebbles = [172.0, 167.0, 154.0].map(|c| c * (1.0 + 0.08 * cast.fine));
        cover(color, pebbles, 0.85 * gravel * (1.0 - snowed));
        let milky = [104.0, 136.0, 132.0];
        for strand in 0..3 {
            let k = f64::from(strand);
            let sway = self.fine.at(site.x / 210.0 + 31.0 * k, site.y / 210.0 - 17.0 * k)
                + 0.4 * self.fine.at(site.x / 80.0 - 9.0 * k, site.y / 80.0 + 23.0 * k);
            let spare = (0.5 * (reach.bed_m - reach.width_m)).max(0.0);
            let share = [0.55, 0.45, 0.3][strand as usize];
            let half = (0.5 * reach.width_m * share).max(0.2 * self.pixel_m);
            let from = (across_m - spare * 1.3 * sway).abs();
            let wet = smoothstep(half + blur, (half - blur).min(half * 0.5), from);
            let full = (2.0 * half / self.pixel_m).clamp(0.3, 1.0);
            cover(color, milky, 0.9 * wet * full * (1.0 - snowed));
        }
    }
}
