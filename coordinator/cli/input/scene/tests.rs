#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

fn parsed(text: &str) -> Result<Scene, String> {
    Scene::parse(Path::new("scenes/s.toml"), text).map_err(|error| error.to_string())
}

const LEAST: &str = "terrain = \"NAME.terrain\"\n";

#[test]
fn the_example_states_the_defaults() {
    assert_eq!(parsed(Scene::example()), parsed(LEAST));
}

#[test]
fn every_commented_key_of_the_example_is_a_key_with_its_default() {
    let is_key = |line: &str| line.starts_with("# [") || line.contains(" = ");
    let text: String = Scene::example()
        .lines()
        .map(|line| line.strip_prefix("# ").filter(|_| is_key(line)).unwrap_or(line))
        .flat_map(|line| [line, "\n"])
        .collect();
    let scene = parsed(&text).unwrap();
    let bare = parsed(&format!("{LEAST}[sun]\n[haze]\n")).unwrap();
    assert_eq!(scene.sun, bare.sun);
    assert_eq!(scene.curvature, Some(true));
    assert!(scene.bare_ground.is_some());
    let (haze, default) = (scene.haze.unwrap(), bare.haze.unwrap());
    assert_eq!(haze.visibility_m, default.visibility_m);
    assert_eq!(haze.scale_height_m, default.scale_height_m);
    for (typed, horizon) in haze.color.into_iter().zip(default.color) {
        assert!((typed - horizon).abs() < 0.01, "{typed} stands for {horizon}");
    }
}

#[test]
fn the_terrain_is_looked_for_beside_the_scene() {
    assert_eq!(parsed(LEAST).unwrap().terrain, Path::new("scenes/NAME.terrain"));
    assert_eq!(parsed("terrain = \"/a/b.terrain\"").unwrap().terrain, Path::new("/a/b.terrain"));
}

#[test]
fn values_are_taken_over() {
    let text = r##"
        terrain = "t.terrain"
        [camera]
        size = "640 x 480"
        hfov = 45
        [sun]
        azimuth = 90
        elevation = 0
        ambient = 0.25
        strength = 1
        [haze]
        visibility_km = 20
        scale_height_m = 1500
        color = "#ffffff"
        [sky]
        zenith = "#000000"
        [earth]
        curvature = false
        [ground]
        color = [0.5, 0.25, 1]
        [output]
        fps = 29.97
        samples = 4
        method = "reference"
        tolerance = 2
    "##;
    let scene = parsed(text).unwrap();
    assert_eq!((scene.size, scene.hfov_deg, scene.fps), ((640, 480), 45.0, 29.97));
    assert_eq!(
        scene.quality,
        Quality { method: Method::Reference, samples_per_side: 4, tolerance_px: 2.0 }
    );
    assert_eq!(scene.sky, Sky { zenith: [0.0; 3], ..Sky::default() });
    let shading = scene.shading(Some(6.37e6), 0.0).unwrap();
    assert_eq!(shading.earth, None);
    assert_eq!(shading.bare_ground, Some([0.5, 0.25, 1.0]));
    let haze = Haze { visibility_m: 2e4, scale_height_m: 1500.0, color: [1.0; 3] };
    assert_eq!(shading.haze, Some(haze));
    let sun = shading.sun.unwrap();
    assert!((sun.direction.x - 1.0).abs() < 1e-12 && sun.ambient == 0.25 && sun.strength == 1.0);
}

#[test]
fn the_earth_is_round_where_the_terrain_has_a_place_on_it() {
    let scene = parsed(LEAST).unwrap();
    let earth = Earth { radius_m: 6.37e6, refraction: 0.13 };
    assert_eq!(scene.shading(Some(6.37e6), 0.0).unwrap().earth, Some(earth));
    assert_eq!(scene.shading(None, 0.0).unwrap().earth, None);
    let round = parsed(&format!("{LEAST}[earth]\ncurvature = true")).unwrap();
    assert!(round.shading(None, 0.0).unwrap_err().contains("curvature = true"));
}

#[test]
fn the_sun_stands_where_true_north_says() {
    let scene = parsed(&format!("{LEAST}[sun]\nazimuth = 88\nelevation = 0")).unwrap();
    let sun = scene.shading(None, 2.0).unwrap().sun.unwrap();
    assert!((sun.direction.x - 1.0).abs() < 1e-12, "{}", sun.direction);
}

#[test]
fn screen_colors_become_linear_light() {
    assert_eq!(screen_color("#000000"), Ok([0.0; 3]));
    assert_eq!(screen_color("#FFffFF"), Ok([1.0; 3]));
    let [half, low, _] = screen_color("#bc0a00").unwrap();
    assert!((half - 0.502_886).abs() < 1e-5 && (low - 0.003_035_3).abs() < 1e-6);
    for wrong in ["", "#fff", "red", "#12345g", "#+12345", "#12345é"] {
        assert!(screen_color(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn sizes_are_read_or_refused() {
    assert_eq!(parse_size("1920x1080"), Ok((1920, 1080)));
    assert_eq!(parse_size(" 4 X 3 "), Ok((4, 3)));
    for wrong in ["", "x", "12", "0x5", "5x0", "99999x5", "-1x5", "1x2x3", "1.5x2"] {
        assert!(parse_size(wrong).unwrap_err().contains("1280x720"), "{wrong}");
    }
}

#[test]
fn a_mistake_is_reported_with_its_line() {
    for (rest, said) in [
        (
            "[camera]\nhfov = 180",
            "s.toml:3: [camera] hfov = 180 is out of range; it may be 1 to 170",
        ),
        ("[camera]\nhfov = nan", "s.toml:3: [camera] hfov = NaN is out of range"),
        ("[camera]\nhfov = \"wide\"", "s.toml:3: invalid type: string"),
        ("[camera]\nsize = \"big\"", "s.toml:3: \"big\" is no size"),
        ("[sun]\n\nelevation = inf", "s.toml:4: [sun] elevation = inf is out of range"),
        ("[haze]\nvisibility_km = 0", "s.toml:3: [haze] visibility_km = 0 is out of range"),
        ("[earth]\nrefraction = 1", "s.toml:3: [earth] refraction = 1 is out of range"),
        ("[sky]\nzenith = \"blue\"", "s.toml:3: \"blue\" is no color"),
        ("[sky]\nzenith = [1, 2, 0]", "s.toml:3: the color [1.0, 2.0, 0.0] has numbers"),
        ("[sky]\nzenith = 7", "s.toml:3: a color is \"#rrggbb\" or three numbers"),
        ("[output]\nsamples = 1.5", "s.toml:3: [output] samples is a whole number"),
        ("[output]\nsamples = 33", "s.toml:3: [output] samples = 33 is out of range"),
        ("[output]\nmethod = \"fast\"", "s.toml:3: unknown method \"fast\"; choose one of"),
        ("[output]\nmethod = \"exat\"", "did you mean \"exact\"?"),
        (
            "[output]\ntolerance = 0",
            "s.toml:3: [output] tolerance = 0 is out of range; it may be 0.01 to 64",
        ),
        ("[output]\ntolerance = -1", "s.toml:3: [output] tolerance = -1 is out of range"),
        ("[output]\ntolerance = nan", "s.toml:3: [output] tolerance = NaN is out of range"),
        ("[output]\ntolerance = inf", "s.toml:3: [output] tolerance = inf is out of range"),
        ("[output]\ntolerance = 64.5", "s.toml:3: [output] tolerance = 64.5 is out of range"),
        ("[output]\ntolerance = 0.001", "s.toml:3: [output] tolerance = 0.001 is out of range"),
        ("[output]\ntolerance = \"half\"", "s.toml:3: invalid type: string"),
        ("[output]\nfsp = 5", "s.toml:3: unknown field `fsp`, expected one of `fps`"),
        ("[clouds]", "s.toml:2: unknown field `clouds`"),
        ("terrain = \"b\"", "s.toml:2: duplicate key"),
    ] {
        let error = parsed(&format!("{LEAST}{rest}")).unwrap_err();
        assert!(error.contains(said), "{rest:?}: {error}");
    }
    assert!(parsed("").unwrap_err().contains("missing field `terrain`"));
    assert!(parsed("terrain = \"\"").unwrap_err().contains("s.toml:1: terrain is empty"));
}

proptest! {
    #[test]
    fn any_text_gives_an_answer(text in "[a-z\\[\\]=\"#0-9. \n]{0,60}") {
        let _ = parsed(&text);
        let _ = parsed(&format!("{LEAST}{text}"));
    }
}
