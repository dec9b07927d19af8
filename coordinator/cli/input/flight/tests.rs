#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

/// A square of 10 km; a degree is 1000 m, true north lies 2 degrees east of grid north,
/// the ground slopes up to the east and has a void beyond x = 9000.
struct Slope;

impl Place for Slope {
    fn to_grid(&self, lon: f64, lat: f64) -> Result<[f64; 2], String> {
        if lat > 80.0 { Err("too far north".into()) } else { Ok([lon * 1000.0, lat * 1000.0]) }
    }

    fn convergence_deg(&self, _: f64, _: f64) -> f64 {
        2.0
    }

    fn ground(&self, x: f64, _: f64) -> Option<f64> {
        (0.0..9000.0).contains(&x).then_some(x / 10.0)
    }

    fn bounds(&self) -> Bounds {
        Bounds { min: [0.0; 2], max: [10_000.0; 2] }
    }
}

fn parsed(text: &str) -> Result<FlightFile, String> {
    parse(Path::new("f.csv"), text, &Slope, 60.0).map_err(|error| error.to_string())
}

fn first(text: &str) -> Keyframe {
    parsed(text).unwrap().flight.keyframes()[0]
}

fn is(keyframe: &Keyframe, place: [f64; 3], angles: [f64; 3]) -> bool {
    let [h, p, r] = angles;
    let other = Keyframe::from_angles(0.0, DVec3::from(place), h, p, r, 60.0);
    keyframe.position.distance(other.position) < 1e-9
        && keyframe.attitude.dot(other.attitude).abs() > 1.0 - 1e-12
}

#[test]
fn columns_come_in_any_order_case_and_spelling() {
    let expected = ([5000.0, 4000.0, 900.0], [32.0, -10.0, 0.0]);
    for text in [
        "t,lon,lat,height,heading,pitch\n0,5,4,900,30,-10",
        "PITCH,Heading,H_M,Latitude,Longitude,Time\n-10,30,900,4,5,0",
        "t;x;y;z;heading;pitch\r\n0;5000,0;4000;900;30;-10\r\n",
        "\"seconds\",\"easting\",\"northing\",\"alt\",\"yaw\",\"tilt\",\"roll\"\n# c\n\n0,5000,4000,900,30,-10,\n",
    ] {
        assert!(is(&first(text), expected.0, expected.1), "{text:?}");
    }
}

#[test]
fn headings_count_from_true_north_unless_the_file_says_grid() {
    let row = "0,5000,4000,900,30,-10";
    let plain = first(&format!("t,x,y,z,heading,pitch\n{row}"));
    let comment = first(&format!("# heading: grid\nt,x,y,z,heading,pitch\n{row}"));
    let column = first(&format!("t,x,y,z,heading,pitch,heading_ref\n{row},GRID"));
    let overruled =
        first(&format!("# Heading: grid\nt,x,y,z,heading,pitch,heading_ref\n{row},true"));
    let at = [5000.0, 4000.0, 900.0];
    assert!(is(&plain, at, [32.0, -10.0, 0.0]));
    assert!(is(&comment, at, [30.0, -10.0, 0.0]));
    assert!(is(&column, at, [30.0, -10.0, 0.0]));
    assert!(is(&overruled, at, [32.0, -10.0, 0.0]));
    let error = parsed("# heading: up\nt,x,y,z,heading,pitch\n0,1,1,1,1,1").unwrap_err();
    assert!(error.starts_with("f.csv:1: \"up\""), "{error}");
}

#[test]
fn heights_above_the_ground_are_added_to_it() {
    let keyframe = first("t,x,y,agl,heading,pitch\n0,5000,4000,120,0,0");
    assert_eq!(keyframe.position.z, 620.0);
    let void = parsed("t,x,y,agl,heading,pitch\n0,5000,4000,120,0,0\n1,9500,4000,120,0,0");
    assert!(void.unwrap_err().starts_with("f.csv:3: column \"agl\": there is no ground"));
}

#[test]
fn the_field_of_view_is_the_scenes_where_the_file_has_none() {
    assert_eq!(first("t,x,y,z,heading,pitch\n0,1,1,1,1,1").hfov_deg, 60.0);
    assert_eq!(first("t,x,y,z,heading,pitch,hfov\n0,1,1,1,1,1,").hfov_deg, 60.0);
    assert_eq!(first("t,x,y,z,heading,pitch,hfov\n0,1,1,1,1,1,35").hfov_deg, 35.0);
}

#[test]
fn a_mistake_is_reported_with_its_line_and_column() {
    let head = "t,lon,lat,height,heading,pitch,roll,hfov\n0,5,4,900,30,-10,0,60\n";
    for (row, said) in [
        ("x,5,4,900,30,-10,0,60", "f.csv:3: column \"t\": \"x\" is not a number"),
        ("1,5,4,900,30,,0,60", "f.csv:3: column \"pitch\": there is no value"),
        ("1,5,4,900,30", "f.csv:3: column \"pitch\": there is no value"),
        (
            "1,5,4,900,30,NaN,0,60",
            "f.csv:3: column \"pitch\": NaN is out of range; it may be -90 to 90",
        ),
        ("1,5,4,inf,30,0,0,60", "f.csv:3: column \"height\": inf is out of range"),
        ("1,5,4,900,30,-91,0,60", "f.csv:3: column \"pitch\": -91 is out of range"),
        (
            "1,5,4,900,30,0,0,171",
            "f.csv:3: column \"hfov\": 171 is out of range; it may be 1 to 170",
        ),
        ("1,400,4,900,30,0,0,60", "f.csv:3: column \"lon\": 400 is out of range"),
        ("1,5,85,900,30,0,0,60", "f.csv:3: column \"lon\": 5, 85: too far north"),
        ("-1,5,4,900,30,0,0,60", "f.csv:3: keyframe 1: its time -1 s is before"),
        ("1,5,4,900,30,0,0,60,9", "f.csv:3: it has 9 fields"),
    ] {
        let error = parsed(&format!("{head}{row}")).unwrap_err();
        assert!(error.starts_with(said), "{error}");
    }
}

#[test]
fn an_unknown_column_is_named_with_the_one_that_was_meant() {
    let error = parsed("t,x,y,z,hedding,pitch\n").unwrap_err();
    assert!(error.contains("f.csv:1: unknown column \"hedding\"; did you mean \"heading\"?"));
    assert!(error.contains("known are t, lon, lat, x, y, height, agl,"), "{error}");
    for (header, said) in [
        ("t,x,y,heading,pitch", "missing: height (or agl)"),
        ("t,x,z,heading,pitch", "missing: y"),
        ("lon,height", "missing: t, lat, heading, pitch"),
        ("t,x,y,lon,lat,z,heading,pitch", "positions are given twice"),
        ("t,x,y,z,agl,heading,pitch", "heights are given twice"),
        ("t,x,y,z,h,heading,pitch", "two columns hold the height"),
    ] {
        let error = parsed(header).unwrap_err();
        assert!(error.contains(said), "{error}");
    }
    assert!(parsed("t,x,y,z,heading,pitch\n").unwrap_err().contains("no keyframes"));
}

#[test]
fn a_flight_elsewhere_is_refused_with_both_extents() {
    let error = parsed("t,lon,lat,height,heading,pitch\n0,40,50,900,30,-10").unwrap_err();
    assert!(error.contains("x 40000 to 40000, y 50000 to 50000"), "{error}");
    assert!(error.contains("x 0 to 10000, y 0 to 10000"), "{error}");
}

#[test]
fn keyframes_outside_or_under_the_ground_are_warnings() {
    let head = "t,x,y,z,heading,pitch\n0,5000,5000,499,0,0\n";
    let rows: String = (1..6).map(|t| format!("{t},-{t},5000,900,0,0\n")).collect();
    let warnings = parsed(&format!("{head}{rows}")).unwrap().warnings;
    assert_eq!(
        warnings,
        ["outside the terrain on line 3, 4, 5 and 2 more", "below the ground on line 2"]
    );
    assert!(parsed("t,x,y,z,heading,pitch\n0,5000,5000,501,0,0").unwrap().warnings.is_empty());
}

#[test]
fn a_file_with_a_byte_order_mark_is_read_and_another_encoding_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("f.csv");
    std::fs::write(&file, b"\xef\xbb\xbft,x,y,z,heading,pitch\r\n0,1,1,900,0,0\r\n").unwrap();
    assert_eq!(read(&file, &Slope, 60.0).unwrap().flight.keyframes().len(), 1);
    std::fs::write(&file, b"t,x\xff\n").unwrap();
    assert!(read(&file, &Slope, 60.0).unwrap_err().message.contains("UTF-8"));
    let missing = read(&folder.path().join("no.csv"), &Slope, 60.0).unwrap_err();
    assert!(missing.message.starts_with("cannot be read"));
}

proptest! {
    #[test]
    fn any_text_gives_an_answer(text in "[a-z0-9,;.\"# \n-]{0,80}") {
        let _ = parsed(&text);
    }

    #[test]
    fn any_fields_give_an_answer(rows in prop::collection::vec("[0-9eE.,+a-f-]{0,24}", 0..5)) {
        let _ = parsed(&format!("t,x,y,z,heading,pitch\n{}", rows.join("\n")));
    }
}
