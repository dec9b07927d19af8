//! The metric grid that suits a place best, when the user names none.

/// EPSG code of the UTM zone on WGS84 at a place, with the exceptions for Norway and
/// Svalbard; Universal Polar Stereographic (east, north) beyond 84° N and 80° S.
pub(crate) fn metric_zone(longitude_deg: f64, latitude_deg: f64) -> u16 {
    const UPS_NORTH: u16 = 5041;
    const UPS_SOUTH: u16 = 5042;
    if latitude_deg >= 84.0 {
        return UPS_NORTH;
    }
    if latitude_deg < -80.0 {
        return UPS_SOUTH;
    }
    let longitude = (longitude_deg + 180.0).rem_euclid(360.0) - 180.0;
    // rem_euclid may round up to 360 itself, hence the limit.
    let mut zone = (((longitude + 180.0) / 6.0).floor() as u16 + 1).min(60);
    if (56.0..64.0).contains(&latitude_deg) && (3.0..12.0).contains(&longitude) {
        zone = 32;
    } else if latitude_deg >= 72.0 && (0.0..42.0).contains(&longitude) {
        // Svalbard: 31, 33, 35 and 37 only, cut at 9, 21 and 33 degrees.
        zone = 31 + 2 * ((longitude + 3.0) / 12.0).floor() as u16;
    }
    let base = if latitude_deg < 0.0 { 32700 } else { 32600 };
    base + zone
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zones_follow_the_utm_map_with_its_exceptions() {
        let cases = [
            (-113.0, 37.2, 32612),
            (-180.0, 10.0, 32601),
            (180.0, 10.0, 32601),
            (179.99, -10.0, 32760),
            (540.0 - 0.01, -10.0, 32760),
            (0.0, 0.0, 32631),
            (0.0, -0.001, 32731),
            (5.3, 60.4, 32632),
            (2.9, 60.4, 32631),
            (8.9, 78.0, 32631),
            (9.0, 78.0, 32633),
            (20.9, 78.0, 32633),
            (21.0, 78.0, 32635),
            (33.0, 78.0, 32637),
            (41.9, 78.0, 32637),
            (42.0, 78.0, 32638),
            (10.0, 84.0, 5041),
            (10.0, 90.0, 5041),
            (10.0, -80.0, 32732),
            (10.0, -80.1, 5042),
        ];
        for (longitude, latitude, code) in cases {
            assert_eq!(metric_zone(longitude, latitude), code, "{longitude} {latitude}");
        }
    }
}
