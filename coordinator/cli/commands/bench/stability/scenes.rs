//! The scenes: ground, camera and truth.

use super::files;
use super::judge::Plane;
use crate::commands::bench::land::{Land, Rule, height_layer};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::shading::{Earth, Shading};
use terrafarm_raycast::View;
use terrafarm_terrain::build::LayerSpec;

/// Radius of the Earth of scenes over round ground, metres.
const EARTH_M: f64 = 6_371_000.0;
const REFRACTION: f64 = 0.13;
const SPACING_M: f64 = 10.0;
/// Colour of everything below the ground: full red and nothing else, in sRGB.
const BELOW: [u8; 3] = [255, 0, 0];

/// What a scene is compared with.
pub enum Truth {
    /// Another method: `exact`, and for it the reference.
    Surface,
    /// As `Surface`, and no pixel sees the sky.
    Closed,
    /// A plane; distances follow from a division.
    Plane(Plane),
    /// The row, in pixels from the top, at which ground begins in the middle column.
    Edge(f64),
    /// The camera is below the ground: every pixel has this colour.
    Below([u8; 3]),
}

/// Ground, camera and truth.
pub struct Scene {
    /// What may go wrong.
    pub name: &'static str,
    /// The ground.
    pub land: Land,
    /// The camera; the method comes later.
    pub view: View,
    /// What is right.
    pub truth: Truth,
}

/// Where the camera stands and looks.
#[derive(Clone, Copy)]
pub struct Pose {
    at: [f64; 3],
    heading: f64,
    pitch: f64,
    roll: f64,
    hfov: f64,
}

/// Upright, with a field of view of 60 degrees.
pub fn look(at: [f64; 3], heading: f64, pitch: f64) -> Pose {
    Pose { at, heading, pitch, roll: 0.0, hfov: 60.0 }
}

/// All scenes at a size of the picture, pixels, both sides odd.
pub fn all(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let mut scenes = rough(size)?;
    scenes.extend(planes(size)?);
    scenes.extend(edges(size)?);
    scenes.extend(odd_grounds(size)?);
    scenes.extend(files::scenes(size)?);
    Ok(scenes)
}

/// The view from a pose, bare of light and air.
pub fn view(pose: Pose, size: (u32, u32), earth: Option<Earth>) -> View {
    let eye = DVec3::from_array(pose.at);
    let Pose { heading, pitch, roll, hfov, .. } = pose;
    let shading = Shading { earth, below_ground: [1.0, 0.0, 0.0], ..Shading::default() };
    let camera = Camera::from_angles(eye, heading, pitch, roll, hfov, size);
    View { camera, shading, quality: Quality::default() }
}

fn made(
    name: &str,
    spec: LayerSpec,
    rule: impl Fn(u64, u64) -> f32 + Sync,
) -> anyhow::Result<Land> {
    Land::made(name, None, spec, &Rule(rule))
}

/// Rough ground from ordinary and extreme cameras, against another method.
fn rough(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let low = Land::noise(257)?.highest_around([1280.0; 2], 30.0)? + 20.0;
    let high = low + 1500.0;
    let [x, y] = [1280.0; 2];
    let poses = [
        ("grazing, two posts above the ground", look([x, y, low], 20.0, 0.0)),
        ("straight down", look([x, y, high], 0.0, -90.0)),
        ("roll 90", Pose { roll: 90.0, ..look([x, y, high], 30.0, -20.0) }),
        ("roll 45", Pose { roll: 45.0, ..look([x, y, high], 30.0, -20.0) }),
        ("field of view 170", Pose { hfov: 170.0, ..look([x, y, high], 30.0, -20.0) }),
        ("silhouettes of far ridges", look([200.0, 200.0, low], 45.0, 2.0)),
    ];
    let mut scenes = Vec::new();
    for (name, pose) in poses {
        let land = Land::noise(257)?;
        scenes.push(Scene { name, land, view: view(pose, size, None), truth: Truth::Surface });
    }
    let buried = look([x, y, low - 400.0], 0.0, 0.0);
    scenes.push(Scene {
        name: "camera below the ground",
        land: Land::noise(257)?,
        view: view(buried, size, None),
        truth: Truth::Below(BELOW),
    });
    Ok(scenes)
}

/// A tilted plane, whose posts f32 holds exactly.
fn plane_land(name: &str, spec: LayerSpec) -> anyhow::Result<(Land, Plane)> {
    let rise = [0.25, 0.125];
    let land = made(name, spec, move |i, j| 100.0 + rise[0] * i as f32 + rise[1] * j as f32)?;
    let corners = land.corners();
    let slope = [0, 1].map(|axis| f64::from(rise[axis]) / spec.spacing[axis]);
    Ok((land, Plane { slope, height_m: 100.0, corners }))
}

/// A plane seen along grid lines, through corners, over seams and far from the origin.
fn planes(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let square = height_layer([SPACING_M; 2], [600; 2], None);
    let utm = LayerSpec { origin: [500_000.0, 5_000_000.0], ..square };
    let long = LayerSpec { spacing: [30.0, 10.0], ..square };
    let seam = 256.0 * SPACING_M;
    let at_seam = [seam, seam, 600.0];
    let poses = [
        (
            "eye over a post, rays along a grid line",
            square,
            look([1000.0, 500.0, 500.0], 0.0, -20.0),
        ),
        ("rays through corners of cells", square, look([1000.0, 1000.0, 500.0], 45.0, -20.0)),
        ("seam of tiles", square, look([seam, 1000.0, 500.0], 0.0, -15.0)),
        ("seam of levels, straight down", square, look(at_seam, 0.0, -90.0)),
        ("roll 90 over a plane", square, Pose { roll: 90.0, ..look(at_seam, 10.0, -30.0) }),
        (
            "field of view 170 over a plane",
            square,
            Pose { hfov: 170.0, ..look(at_seam, 10.0, -50.0) },
        ),
        ("5000 km from the origin", utm, look([501_000.01, 5_001_000.01, 215.0], 33.0, -15.0)),
        ("posts three times as far along x", long, look([3000.0, 1000.0, 500.0], 60.0, -20.0)),
    ];
    let mut scenes = Vec::new();
    for (name, spec, pose) in poses {
        let (land, plane) = plane_land(name, spec)?;
        scenes.push(Scene { name, land, view: view(pose, size, None), truth: Truth::Plane(plane) });
    }
    Ok(scenes)
}

/// The row at which something of this elevation shows in a level picture.
fn row_px(view: &View, tangent: f64) -> f64 {
    f64::from(view.camera.height) / 2.0 - tangent * view.camera.focal_px()
}

/// Horizons and peaks whose row a formula tells.
fn edges(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let earth = Earth { radius_m: EARTH_M, refraction: REFRACTION };
    let radius = earth.effective_radius_m();
    let sea = height_layer([400.0; 2], [257; 2], Some(1.0));
    let ridge_m = 300_000.0;
    let far = height_layer([1000.0; 2], [65, 401], Some(1.0));
    let near = height_layer([SPACING_M; 2], [201; 2], Some(1.0));
    let level = |at| look(at, 0.0, 0.0);

    let (eye, peak) = (2000.0, 9000.0);
    let arc = ridge_m / radius;
    let tangent_far =
        ((radius + peak) * libm::cos(arc) - (radius + eye)) / ((radius + peak) * libm::sin(arc));
    let drop = -libm::tan(libm::acos(radius / (radius + 100.0)));
    let mut scenes = Vec::new();
    let mut add = |name, land: Land, pose, earth, tangent| {
        let view = view(pose, size, earth);
        let truth = Truth::Edge(row_px(&view, tangent));
        scenes.push(Scene { name, land, view, truth });
    };
    let half = 51_200.0;
    add(
        "sea to the horizon",
        made("sea", sea, |_, _| 0.0)?,
        level([half, half, 100.0]),
        Some(earth),
        drop,
    );
    let ridge = made("ridge", far, |_, j| if j == 350 { 9000.0 } else { 0.0 })?;
    let before = [32_000.0, 350_000.0 - ridge_m, eye];
    add("peak at 300 km", ridge, level(before), Some(earth), tangent_far);
    let cliff = made("cliff", near, |_, j| if j >= 100 { 1000.0 } else { 0.0 })?;
    add("cliff of 1000 m", cliff, level([1000.0, 200.0, 900.0]), None, 100.0 / 800.0);
    let spike = made("spike", near, |i, j| if (i, j) == (100, 100) { 30.0 } else { 0.0 })?;
    add("spike of one post", spike, level([1000.0, 600.0, 10.0]), None, 20.0 / 400.0);
    let peak = made("high", near, |_, j| if j == 100 { 884_800.0 } else { 884_000.0 })?;
    add("heights times 100", peak, level([1000.0, 200.0, 884_700.0]), None, 100.0 / 800.0);
    Ok(scenes)
}

/// Grounds with holes and of odd sizes, against another method.
fn odd_grounds(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let hills = |i: u64, j: u64| (300 + (i * 7919 + j * 104_729) % 61) as f32;
    let holed = move |i: u64, j: u64| match (i / 9 + j / 7) % 5 {
        0 => f32::NAN,
        _ => hills(i, j),
    };
    let square = |posts| height_layer([SPACING_M; 2], posts, Some(1.0));
    let down = |x, y| look([x, y, 700.0], 10.0, -35.0);
    let grounds = [
        ("voids", made("voids", square([300; 2]), holed)?, down(1000.0, 200.0)),
        ("one row of posts", made("row", square([300, 1]), hills)?, down(100.0, -300.0)),
        ("one post", made("post", square([1, 1]), hills)?, down(0.0, -300.0)),
        ("two by two posts", made("four", square([2, 2]), hills)?, down(5.0, -300.0)),
        (
            "sizes beside a power of two",
            made("odd", square([258, 259]), hills)?,
            down(1000.0, 200.0),
        ),
        (
            "below the datum",
            made("low", square([300; 2]), move |i, j| hills(i, j) - 790.0)?,
            down(1000.0, 200.0),
        ),
        ("all heights equal", made("flat", square([300; 2]), |_, _| 300.0)?, down(1000.0, 200.0)),
    ];
    let scene = |(name, land, pose)| Scene {
        name,
        land,
        view: view(pose, size, None),
        truth: Truth::Surface,
    };
    Ok(grounds.into_iter().map(scene).collect())
}
