//! Reference systems: EPSG codes, proj strings, WKT. What is read can be used, and its
//! text reads as the same grid.

#![no_main]

use terrafarm_geo::{Crs, Transformer};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let texts = [
        "EPSG:32612",
        "urn:ogc:def:crs:EPSG::3857",
        "http://www.opengis.net/def/crs/EPSG/0/4326",
        "LOCAL",
        "+proj=utm +zone=12 +datum=WGS84",
        "+proj=lcc +lat_1=49 +lat_2=46 +lat_0=47.5 +lon_0=13 +x_0=4e5 +y_0=4e5 +ellps=bessel \
         +towgs84=577.3,90.1,463.9,5.137,1.474,5.297,2.4232 +units=m +no_defs",
        "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=500000 +a=6378137 +rf=298.257 +to_meter=0.3048",
        "+proj=stere +lat_0=90 +lat_ts=70 +lon_0=-45",
        "+proj=somerc +lat_0=46.95 +lon_0=7.44 +ellps=bessel +pm=greenwich +axis=wsu",
        "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563]],\
         PRIMEM[\"Greenwich\",0],UNIT[\"degree\",0.0174532925199433]]",
        "PROJCS[\"UTM 12N\",GEOGCS[\"GCS_NAD_1983\",DATUM[\"D_North_American_1983\",\
         SPHEROID[\"GRS_1980\",6378137,298.257222101],TOWGS84[0,0,0,0,0,0,0]],\
         PRIMEM[\"Greenwich\",0],UNIT[\"Degree\",0.0174532925199433]],\
         PROJECTION[\"Transverse_Mercator\"],PARAMETER[\"False_Easting\",500000],\
         PARAMETER[\"False_Northing\",0],PARAMETER[\"Central_Meridian\",-111],\
         PARAMETER[\"Scale_Factor\",0.9996],PARAMETER[\"Latitude_Of_Origin\",0],\
         UNIT[\"Meter\",1]]",
        "PROJCS[\"x\",AUTHORITY[\"EPSG\",\"2056\"]]",
    ];
    texts.map(|text| text.as_bytes().to_vec()).to_vec()
}

fn accepts(input: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(input) else { return false };
    let Ok(crs) = Crs::parse(text) else { return false };
    let again = Crs::parse(crs.text()).expect("the text of a system can be read");
    assert!(crs.is_same_grid(&again), "{} reads as another grid", crs.text());
    assert!(crs.unit_m().is_none_or(|unit| unit.is_finite() && unit > 0.0));
    for point in [[0.0, 0.0], [500_000.0, 4e6], [-111.0, 40.0], [1e300, -1e300], [f64::NAN, 1.0]] {
        let there_and_back = crs.to_lonlat(point).and_then(|lonlat| crs.from_lonlat(lonlat));
        let numbers = [crs.convergence_deg(point), crs.scale(point)].into_iter().flatten();
        let points = there_and_back.into_iter().chain(crs.from_lonlat(point)).flatten();
        assert!(points.chain(numbers).all(|number| number.is_finite()), "{} {point:?}", crs.text());
        let metric = Crs::suggest_metric(point[0], point[1]);
        let Ok(transformer) = Transformer::new(&crs, &metric) else { continue };
        let found = transformer.apply_one(point);
        let is_one_kind = found.iter().all(|v| v.is_finite()) || found.iter().all(|v| v.is_nan());
        assert!(is_one_kind || transformer.is_identity(), "{} {point:?}: {found:?}", crs.text());
    }
    true
}
