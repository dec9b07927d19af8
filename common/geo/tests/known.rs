//! Positions that are known from elsewhere, and what users write. Round trips may lose
//! a millimetre: a datum shift changes heights, which are not carried along.

#![allow(clippy::unwrap_used, missing_docs)]

use proptest::prelude::*;
use terrafarm_geo::{Crs, CrsError, Transformer, gaussian_radius_m};

/// EPSG code, longitude, latitude, x, y, tolerance in units of the system. Values from
/// PROJ 9 with its grids; the tolerance is that of the datum shift.
const KNOWN: [(u16, [f64; 2], [f64; 2], f64); 27] = [
    (32612, [-113.0, 37.25], [322622.446619, 4124480.586951], 1e-5),
    (32612, [-111.0, 0.0], [500000.0, 0.0], 1e-5),
    (32760, [179.5, -16.5], [766875.130350, 8174101.733034], 1e-5),
    (3857, [138.7275, 35.3608], [15443074.659024, 4213021.164605], 1e-5),
    (2154, [6.8652, 45.8326], [999929.385002, 6533226.239686], 1e-3),
    (27700, [-0.1, 51.5], [531979.29, 179606.91], 4.0),
    (3035, [10.0, 52.0], [4321000.0, 3210000.0], 1e-3),
    (3413, [-45.0, 72.0], [0.0, -1965440.664760], 1e-5),
    (3413, [100.0, 89.5], [31067.188523, 44368.543364], 1e-5),
    (3031, [166.67, -77.85], [305467.162732, -1289201.537714], 1e-5),
    (26710, [-122.19, 46.2], [562586.83, 5116393.50], 12.0),
    (5514, [14.42, 50.09], [-742860.08, -1042721.36], 10.0),
    (21781, [7.98, 46.55], [641519.14, 155555.38], 2.0),
    (2056, [7.98, 46.55], [2641519.14, 1155555.38], 2.0),
    (31370, [4.35, 50.85], [148679.45, 171066.81], 2.0),
    (5070, [-100.0, 40.0], [-338390.587551, 1894100.140043], 1e-3),
    (3338, [-150.0, 62.0], [208758.073022, 1342262.646875], 1e-3),
    (2193, [172.5, -43.5], [1559577.808344, 5183537.208822], 1e-3),
    (28355, [147.0, -36.5], [500000.0, 5960591.917535], 1e-3),
    (2225, [-122.0, 40.5], [6561666.667, 2065427.6197], 1e-2),
    (31467, [9.0, 48.0], [3500075.40, 5317988.04], 3.0),
    (5041, [30.0, 88.0], [2111034.634464, 1807682.371708], 1e-5),
    (5042, [-100.0, -85.0], [1452981.254498, 1903545.836215], 1e-5),
    (3978, [-95.0, 60.0], [0.0, 1204290.900083], 1e-3),
    (2180, [19.0, 52.0], [500000.0, 459309.209402], 1e-3),
    (25832, [9.0, 48.0], [500000.0, 5316300.224329], 1e-3),
    (2046, [14.5, -31.0], [47752.417931, 3431081.638142], 1e-3),
];

#[test]
fn positions_agree_with_the_authorities_values() {
    for (code, lonlat, xy, tolerance) in KNOWN {
        let crs = Crs::parse(&format!("EPSG:{code}")).unwrap();
        let found = crs.from_lonlat(lonlat).unwrap();
        let off = (found[0] - xy[0]).hypot(found[1] - xy[1]);
        assert!(off <= tolerance, "EPSG:{code} at {lonlat:?}: {found:?} is {off} from {xy:?}");
        let back = crs.to_lonlat(found).unwrap();
        let off_deg = (back[0] - lonlat[0]).hypot(back[1] - lonlat[1]);
        assert!(off_deg < 1e-7, "EPSG:{code}: {lonlat:?} came back as {back:?}");
    }
}

#[test]
fn texts_are_read_in_all_the_ways_they_are_written() {
    let cases = [
        ("epsg:32612", "EPSG:32612"),
        (" EPSG:32612\n", "EPSG:32612"),
        ("urn:ogc:def:crs:EPSG::32612", "EPSG:32612"),
        ("http://www.opengis.net/def/crs/EPSG/0/32612", "EPSG:32612"),
        ("EPSG:32612+5773", "EPSG:32612"),
        ("wgs84", "EPSG:4326"),
        ("local", "LOCAL"),
        ("+proj=utm +zone=12 +datum=WGS84", "+proj=utm +zone=12 +datum=WGS84"),
        ("LOCAL_CS[\"engineering\",UNIT[\"metre\",1]]", "LOCAL"),
        (ESRI_UTM, "EPSG:26912"),
        (ESRI_GEOGRAPHIC_WITH_CODE, "EPSG:4326"),
        ("PROJCRS[\"x\",BASEGEOGCRS[\"y\"],ID[\"EPSG\",2154]]", "EPSG:2154"),
    ];
    for (text, canonical) in cases {
        let crs = Crs::parse(text).unwrap_or_else(|error| panic!("{text}: {error}"));
        assert_eq!(crs.text(), canonical);
        assert!(Crs::parse(crs.text()).unwrap().is_same_grid(&crs));
    }
}

const ESRI_UTM: &str = "PROJCS[\"NAD_1983_UTM_Zone_12N\",GEOGCS[\"GCS_North_American_1983\",\
    DATUM[\"D_North_American_1983\",SPHEROID[\"GRS_1980\",6378137.0,298.257222101]],\
    PRIMEM[\"Greenwich\",0.0],UNIT[\"Degree\",0.0174532925199433]],\
    PROJECTION[\"Transverse_Mercator\"],PARAMETER[\"False_Easting\",500000.0],\
    PARAMETER[\"False_Northing\",0.0],PARAMETER[\"Central_Meridian\",-111.0],\
    PARAMETER[\"Scale_Factor\",0.9996],PARAMETER[\"Latitude_Of_Origin\",0.0],UNIT[\"Meter\",1.0]]";
const ESRI_GEOGRAPHIC_WITH_CODE: &str = "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",\
    SPHEROID[\"WGS 84\",6378137,298.257223563,AUTHORITY[\"EPSG\",\"7030\"]],\
    AUTHORITY[\"EPSG\",\"6326\"]],PRIMEM[\"Greenwich\",0],UNIT[\"degree\",0.0174532925199433],\
    AUTHORITY[\"EPSG\",\"4326\"]]";

/// WKT without codes, the EPSG code of the same system, a place in it, and how far the
/// two may differ in metres.
#[test]
fn well_known_text_means_the_same_as_its_code() {
    let gcs = |datum: &str, spheroid: &str| {
        format!(
            "GEOGCS[\"g\",DATUM[\"{datum}\",SPHEROID[\"s\",{spheroid}]],PRIMEM[\"Greenwich\",0.0],\
             UNIT[\"Degree\",0.0174532925199433]]"
        )
    };
    let grs80 = "6378137.0,298.257222101";
    let wgs84 = "6378137.0,298.257223563";
    let cases = [
        (
            gcs("D_RGF_1993", grs80),
            "Lambert_Conformal_Conic",
            "\"False_Easting\",700000 \"False_Northing\",6600000 \"Central_Meridian\",3 \
             \"Standard_Parallel_1\",44 \"Standard_Parallel_2\",49 \"Latitude_Of_Origin\",46.5",
            1.0,
            2154,
            [2.0, 48.0],
        ),
        (
            gcs("D_North_American_1983", grs80),
            "Lambert_Conformal_Conic",
            "\"False_Easting\",6561666.666666666 \"False_Northing\",1640416.666666667 \
             \"Central_Meridian\",-122 \"Standard_Parallel_1\",40 \
             \"Standard_Parallel_2\",41.66666666666666 \"Latitude_Of_Origin\",39.33333333333334",
            0.3048006096012192,
            2225,
            [-121.0, 40.5],
        ),
        (
            gcs("D_WGS_1984", wgs84),
            "Stereographic_North_Pole",
            "\"False_Easting\",0 \"False_Northing\",0 \"Central_Meridian\",-45 \
             \"Standard_Parallel_1\",70",
            1.0,
            3413,
            [-40.0, 75.0],
        ),
        (
            gcs("WGS_1984", wgs84),
            "Polar_Stereographic",
            "\"latitude_of_origin\",-71 \"central_meridian\",0 \"false_easting\",0 \
             \"false_northing\",0 \"scale_factor\",1",
            1.0,
            3031,
            [100.0, -80.0],
        ),
        (
            gcs("D_WGS_1984", wgs84),
            "Mercator_Auxiliary_Sphere",
            "\"False_Easting\",0 \"False_Northing\",0 \"Central_Meridian\",0 \
             \"Standard_Parallel_1\",0 \"Auxiliary_Sphere_Type\",0",
            1.0,
            3857,
            [138.7, 35.4],
        ),
        (
            gcs("D_ETRS_1989", grs80),
            "Lambert_Azimuthal_Equal_Area",
            "\"False_Easting\",4321000 \"False_Northing\",3210000 \"Central_Meridian\",10 \
             \"Latitude_Of_Origin\",52",
            1.0,
            3035,
            [20.0, 60.0],
        ),
        (
            gcs("D_OSGB_1936", "6377563.396,299.3249646"),
            "Transverse_Mercator",
            "\"False_Easting\",400000 \"False_Northing\",-100000 \"Central_Meridian\",-2 \
             \"Scale_Factor\",0.9996012717 \"Latitude_Of_Origin\",49",
            1.0,
            27700,
            [-1.0, 52.0],
        ),
        (
            gcs("D_North_American_1927", "6378206.4,294.9786982"),
            "Albers",
            "\"False_Easting\",0 \"False_Northing\",0 \"Central_Meridian\",-96 \
             \"Standard_Parallel_1\",29.5 \"Standard_Parallel_2\",45.5 \"Latitude_Of_Origin\",23",
            1.0,
            5069,
            [-100.0, 40.0],
        ),
    ];
    for (gcs, projection, parameters, unit, code, place) in cases {
        let parameters: String = parameters
            .split_whitespace()
            .map(|parameter| format!("PARAMETER[{parameter}],"))
            .collect();
        let text = format!(
            "PROJCS[\"p\",{gcs},PROJECTION[\"{projection}\"],{parameters}UNIT[\"u\",{unit}]]"
        );
        let described = Crs::parse(&text).unwrap_or_else(|error| panic!("{text}: {error}"));
        let coded = Crs::parse(&format!("EPSG:{code}")).unwrap();
        let a = described.from_lonlat(place).unwrap();
        let b = coded.from_lonlat(place).unwrap();
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-2, "EPSG:{code}: {a:?} and {b:?}");
    }
}

#[test]
fn unknown_texts_are_refused_with_an_example() {
    let cases = [
        "",
        "EPSG:1",
        "EPSG:99999999",
        "EPSG:utm",
        "utm 12",
        "+proj=nonsense +datum=WGS84",
        "+proj=utm +zone=12 +datum=mars",
        "+zone=3",
        "+proj=geocent +datum=WGS84",
        "PROJCS[",
        "PROJCS[\"a\"",
        "VERT_CS[\"x\"]",
        "EPSG:4807",
        "+proj=utm +zone=99",
        "PROJCS[[[[",
        "+proj=tmerc +to_meter=0",
        "+proj=longlat +towgs84=1,2",
    ];
    for text in cases {
        let error = Crs::parse(text).unwrap_err();
        assert!(error.to_string().contains("EPSG:32612"), "{text}: {error}");
        assert!(matches!(error, CrsError::Unknown { .. }));
    }
}

#[test]
fn kinds_of_systems_are_told_apart() {
    // Text, geographic, metric and projected.
    let cases = [
        ("EPSG:4326", true, false),
        ("EPSG:32612", false, true),
        ("EPSG:2225", false, false),
        ("EPSG:2046", false, false),
        ("EPSG:3857", false, true),
        ("LOCAL", false, false),
        ("+proj=utm +zone=12 +datum=WGS84 +units=km", false, false),
    ];
    for (text, geographic, metric) in cases {
        let crs = Crs::parse(text).unwrap();
        assert_eq!(
            (crs.is_geographic(), crs.is_metric_projected()),
            (geographic, metric),
            "{text}"
        );
    }
    assert!(Crs::parse("LOCAL").unwrap().is_local());
    assert_eq!(Crs::parse("EPSG:32612").unwrap().name(), "WGS 84 / UTM zone 12N");
}

#[test]
fn the_same_grid_is_recognised_however_it_is_written() {
    let same = [
        ("EPSG:32612", "+proj=utm +zone=12 +datum=WGS84 +units=m +no_defs"),
        ("EPSG:32612", "EPSG:26912"),
        ("EPSG:32733", "+proj=utm +zone=33 +south +ellps=WGS84"),
        ("EPSG:4326", "EPSG:4269"),
        ("LOCAL", "local"),
    ];
    for (a, b) in same {
        assert!(Crs::parse(a).unwrap().is_same_grid(&Crs::parse(b).unwrap()), "{a} {b}");
    }
    let different = [
        ("EPSG:32612", "EPSG:32613"),
        ("EPSG:32612", "EPSG:32712"),
        ("EPSG:26712", "EPSG:26912"),
        ("EPSG:32612", "LOCAL"),
        ("EPSG:4326", "EPSG:4267"),
        ("EPSG:3857", "EPSG:3395"),
    ];
    for (a, b) in different {
        assert!(!Crs::parse(a).unwrap().is_same_grid(&Crs::parse(b).unwrap()), "{a} {b}");
    }
}

#[test]
fn old_datums_carry_a_warning_and_modern_ones_do_not() {
    for text in ["EPSG:26710", "+proj=utm +zone=10 +ellps=clrk66", "EPSG:4272", "EPSG:27700"] {
        assert!(!Crs::parse(text).unwrap().warnings().is_empty(), "{text}");
    }
    for text in ["EPSG:32612", "EPSG:26912", "EPSG:3857", "EPSG:2154"] {
        assert_eq!(Crs::parse(text).unwrap().warnings(), [""; 0], "{text}");
    }
}

#[test]
fn convergence_and_scale_agree_with_the_utm_tables() {
    let utm = Crs::parse("EPSG:32612").unwrap();
    // 3 degrees east of the central meridian at 40 N: atan(tan 3 x sin 40) = 1.9294 on a
    // sphere; the scale of UTM there is 0.9996 (1 + (cos 40 x 3 in radians)^2 / 2).
    let east = utm.from_lonlat([-108.0, 40.0]).unwrap();
    let west = utm.from_lonlat([-114.0, 40.0]).unwrap();
    assert!((utm.convergence_deg(east).unwrap() + 1.9294).abs() < 2e-3);
    assert!((utm.convergence_deg(west).unwrap() - 1.9294).abs() < 2e-3);
    assert!((utm.scale(east).unwrap() - 1.000405).abs() < 1e-5);
    let middle = utm.from_lonlat([-111.0, 40.0]).unwrap();
    assert!(utm.convergence_deg(middle).unwrap().abs() < 1e-7);
    assert!((utm.scale(middle).unwrap() - 0.9996).abs() < 1e-7);
    let web = Crs::parse("EPSG:3857").unwrap();
    let fuji = web.from_lonlat([138.7275, 35.3608]).unwrap();
    assert!((web.scale(fuji).unwrap() - 1.23).abs() < 0.01);
    // On the south polar grid the meridian of 90 E points to the right, so north, which
    // leads away from the pole, does so, too.
    let south = Crs::parse("EPSG:5042").unwrap();
    let place = south.from_lonlat([90.0, -85.0]).unwrap();
    assert!((south.convergence_deg(place).unwrap() - 90.0).abs() < 1e-6);
}

#[test]
fn a_step_towards_true_north_follows_the_convergence() {
    let crs = Crs::parse("EPSG:2154").unwrap();
    let start = crs.from_lonlat([-3.0, 48.0]).unwrap();
    let end = crs.from_lonlat([-3.0, 48.01]).unwrap();
    let heading_on_grid = (end[0] - start[0]).atan2(end[1] - start[1]).to_degrees();
    assert!((heading_on_grid - crs.convergence_deg(start).unwrap()).abs() < 1e-2);
}

#[test]
fn radii_agree_with_the_ellipsoid() {
    // sqrt(M N) of WGS84: b at the equator, a^2 / b at the poles.
    assert!((gaussian_radius_m(0.0) - 6_356_752.314).abs() < 0.01);
    assert!((gaussian_radius_m(90.0) - 6_399_593.626).abs() < 0.01);
    assert_eq!(gaussian_radius_m(45.0), gaussian_radius_m(-45.0));
}

#[test]
fn the_antimeridian_is_a_place_like_any_other() {
    let utm = Crs::parse("EPSG:32601").unwrap();
    let a = utm.from_lonlat([180.0, 52.0]).unwrap();
    let b = utm.from_lonlat([-180.0, 52.0]).unwrap();
    assert!((a[0] - b[0]).abs() < 1e-6);
    let west = utm.from_lonlat([179.9, 52.0]).unwrap();
    let beyond = utm.from_lonlat([180.1, 52.0]).unwrap();
    assert!(west[0] < a[0] && a[0] < beyond[0]);
    assert_eq!(utm.to_lonlat(beyond).unwrap()[0].round(), -180.0);
    // 0 ..= 360 is the same as -180 ..= 180.
    let crs = Crs::parse("EPSG:32612").unwrap();
    let a = crs.from_lonlat([247.0, 37.0]).unwrap();
    let b = crs.from_lonlat([-113.0, 37.0]).unwrap();
    assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-6);
    assert_eq!(Crs::parse("EPSG:4326").unwrap().to_lonlat([190.0, 1.0]).unwrap(), [-170.0, 1.0]);
}

#[test]
fn poles_lie_in_polar_grids_and_nowhere_in_mercator() {
    let north = Crs::parse("EPSG:5041").unwrap();
    let pole = north.from_lonlat([12.0, 90.0]).unwrap();
    assert!((pole[0] - 2e6).abs() < 1e-6 && (pole[1] - 2e6).abs() < 1e-6);
    assert!((north.to_lonlat([2e6, 2e6]).unwrap()[1] - 90.0).abs() < 1e-9);
    assert!(north.convergence_deg([2e6, 2e6]).unwrap().is_finite());
    let mercator = Crs::parse("EPSG:3857").unwrap();
    let error = mercator.from_lonlat([0.0, 90.0]).unwrap_err();
    assert!(matches!(error, CrsError::OutOfDomain { .. }), "{error}");
    let geographic = Crs::parse("EPSG:4326").unwrap();
    assert!(mercator.from_lonlat([0.0, 91.0]).is_err());
    assert!(geographic.to_lonlat([0.0, 90.5]).is_err());
}

#[test]
fn a_point_out_of_domain_becomes_nan_and_spares_its_neighbours() {
    let from = Crs::parse("EPSG:4326").unwrap();
    let to = Crs::parse("EPSG:3857").unwrap();
    let mut points = [[0.0, 0.0], [0.0, 90.0], [f64::INFINITY, 0.0], [10.0, 10.0]];
    Transformer::new(&from, &to).unwrap().apply(&mut points);
    let valid = points.map(|point| point[0].is_finite() && point[1].is_finite());
    assert_eq!(valid, [true, false, false, true]);
}

#[test]
fn local_terrain_is_refused_where_a_place_is_needed() {
    let local = Crs::parse("LOCAL").unwrap();
    let utm = Crs::parse("EPSG:32612").unwrap();
    assert_eq!(local.to_lonlat([0.0, 0.0]), Err(CrsError::Nowhere));
    assert_eq!(local.convergence_deg([0.0, 0.0]), Err(CrsError::Nowhere));
    assert!(Transformer::new(&local, &utm).is_err());
    let mut points = [[1.5, 2.5]];
    Transformer::new(&local, &local).unwrap().apply(&mut points);
    assert_eq!(points, [[1.5, 2.5]]);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn round_trips_return_to_the_start(
        case in 0usize..KNOWN.len(), dx in -1.0f64..1.0, dy in -0.4f64..0.4,
    ) {
        let (code, [longitude, latitude], _, _) = KNOWN[case];
        let start = [longitude + dx, latitude + dy];
        let crs = Crs::parse(&format!("EPSG:{code}")).unwrap();
        let back = crs.to_lonlat(crs.from_lonlat(start).unwrap()).unwrap();
        let turn = (back[0] - start[0] + 540.0).rem_euclid(360.0) - 180.0;
        prop_assert!(turn.abs() < 1e-7 && (back[1] - start[1]).abs() < 1e-7, "{start:?} {back:?}");
    }

    #[test]
    fn every_place_on_earth_has_a_metric_grid_that_is_true_to_scale(
        longitude in -180.0f64..=360.0, latitude in -90.0f64..=90.0,
    ) {
        let crs = Crs::suggest_metric(longitude, latitude);
        prop_assert!(crs.is_metric_projected());
        let xy = crs.from_lonlat([longitude, latitude]).unwrap();
        prop_assert!((crs.scale(xy).unwrap() - 1.0).abs() < 0.008, "{crs:?}");
    }

    #[test]
    fn no_point_can_panic(
        code in proptest::sample::select(vec![4326u16, 32612, 3857, 2154, 27700, 3031, 5514, 26710, 3035, 5070]),
        x in proptest::num::f64::ANY, y in proptest::num::f64::ANY,
    ) {
        let crs = Crs::parse(&format!("EPSG:{code}")).unwrap();
        let _ = (crs.to_lonlat([x, y]), crs.from_lonlat([x, y]), crs.scale([x, y]));
        let _ = (crs.convergence_deg([x, y]), Crs::suggest_metric(x, y));
    }

    #[test]
    fn no_text_can_panic(text in ".{0,80}") {
        let _ = Crs::parse(&text);
    }

    #[test]
    fn no_definition_can_panic(
        words in proptest::collection::vec(
            "\\+(proj|zone|lat_0|lon_0|lat_1|k|a|b|rf|ellps|datum|towgs84|pm|units|to_meter|axis|R)=(utm|lcc|omerc|krovak|aea|somerc|GRS80|bessel|-?[0-9]{1,4}(\\.[0-9])?|paris|wsu|m)",
            0..8,
        ),
    ) {
        if let Ok(crs) = Crs::parse(&words.join(" ")) {
            let _ = (crs.to_lonlat([1e5, 1e6]), crs.from_lonlat([1.0, 45.0]));
        }
    }

    #[test]
    fn no_well_known_text_can_panic(
        text in "(PROJCS|GEOGCS|DATUM|UNIT|SPHEROID|[\\[\\]\",0-9a-z\\.]){0,60}"
    ) {
        let _ = Crs::parse(&text);
    }

    #[test]
    fn no_damaged_well_known_text_can_panic(cut in 0usize..400, insert in ".") {
        let mut text = ESRI_UTM.to_owned();
        let at = cut.min(text.len());
        text.insert_str(at, &insert);
        let _ = (Crs::parse(&text), Crs::parse(&ESRI_UTM[..at]));
    }
}
