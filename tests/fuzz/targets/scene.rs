//! Scene files.

#![no_main]

use std::path::Path;

#[allow(dead_code, reason = "what the program reads besides")]
#[path = "../../../coordinator/cli/input/mod.rs"]
mod input;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let sparse = "terrain = \"a.terrain\"\n[sun]\n[haze]\ncolor = [0.1, 0.2, 0.3]\n";
    [input::scene::Scene::example(), sparse].map(|text| text.as_bytes().to_vec()).to_vec()
}

fn accepts(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let file = Path::new("folder/scene.toml");
    let scene = match input::scene::Scene::parse(file, text) {
        Ok(scene) => scene,
        Err(error) => {
            let lines = text.lines().count() + 1;
            assert!(error.line.is_none_or(|line| (1..=lines).contains(&line)), "{error}");
            return false;
        }
    };
    let shading = scene.shading(Some(6.37e6), 1.5).expect("terrain with a place on Earth");
    let numbers = [shading.below_ground, shading.sky.horizon, shading.sky.zenith].concat();
    assert!(numbers.iter().all(|number| (0.0..=1.0).contains(number)));
    assert!(scene.fps > 0.0 && scene.size.0 > 0 && scene.size.1 > 0);
    true
}
