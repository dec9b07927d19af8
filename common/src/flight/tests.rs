#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

fn key(t: f64, x: f64, y: f64, z: f64) -> Keyframe {
    Keyframe::from_angles(t, DVec3::new(x, y, z), 0.0, 0.0, 0.0, 60.0)
}

fn look(t: f64, heading: f64, pitch: f64, roll: f64) -> Keyframe {
    Keyframe::from_angles(t, DVec3::ZERO, heading, pitch, roll, 60.0)
}

fn flight(keyframes: &[Keyframe]) -> Flight {
    Flight::new(keyframes.to_vec()).unwrap()
}

fn heading_deg(pose: &Pose) -> f64 {
    let forward = pose.attitude * DVec3::Y;
    forward.x.atan2(forward.y).to_degrees()
}

#[test]
fn two_keyframes_are_a_straight_line_at_constant_speed() {
    let flight = flight(&[key(2.0, 0.0, 0.0, 100.0), key(12.0, 100.0, -50.0, 300.0)]);
    for step in 0..=100 {
        let share = f64::from(step) / 100.0;
        let expected = DVec3::new(100.0 * share, -50.0 * share, 100.0 + 200.0 * share);
        assert!(flight.pose_at(2.0 + 10.0 * share).position.distance(expected) < 1e-10);
    }
}

#[test]
fn one_keyframe_is_a_still() {
    let flight = flight(&[key(5.0, 1.0, 2.0, 3.0)]);
    assert_eq!(flight.duration_s(), 0.0);
    for t in [f64::NEG_INFINITY, 0.0, 5.0, 9.0, f64::INFINITY, f64::NAN] {
        assert_eq!(flight.pose_at(t).position, DVec3::new(1.0, 2.0, 3.0));
    }
    assert_eq!(flight.frame_times(25.0).unwrap().collect::<Vec<_>>(), [5.0]);
}

#[test]
fn outside_its_time_a_flight_rests_at_its_ends() {
    let flight = flight(&[key(0.0, 0.0, 0.0, 0.0), key(1.0, 9.0, 0.0, 0.0)]);
    assert_eq!(flight.pose_at(-1.0), flight.pose_at(0.0));
    assert_eq!(flight.pose_at(7.0).position.x, 9.0);
    assert_eq!(flight.pose_at(f64::NAN).position.x, 0.0);
}

#[test]
fn a_straight_leg_at_constant_speed_stays_one_before_a_turn() {
    let keys: Vec<_> = (0..5).map(|i| key(f64::from(i), 100.0 * f64::from(i), 0.0, 50.0)).collect();
    let flight = flight(&[&keys[..], &[key(5.0, 400.0, 100.0, 90.0)]].concat());
    for step in 0..=300 {
        let t = f64::from(step) / 100.0;
        assert!(flight.pose_at(t).position.distance(DVec3::new(100.0 * t, 0.0, 50.0)) < 1e-9);
    }
}

#[test]
fn an_orbit_with_a_keyframe_every_45_degrees_is_round_and_even() {
    let keys: Vec<_> = (0..=16)
        .map(|i| {
            let angle = f64::from(i) * 45.0;
            let (sin, cos) = angle.to_radians().sin_cos();
            let place = DVec3::new(1000.0 * sin, 1000.0 * cos, 500.0);
            Keyframe::from_angles(f64::from(i), place, angle + 180.0, -20.0, 0.0, 60.0)
        })
        .collect();
    let flight = flight(&keys);
    let true_speed = 1000.0 * 45f64.to_radians();
    for step in 300..1300 {
        let t = f64::from(step) / 100.0;
        let (here, next) = (flight.pose_at(t), flight.pose_at(t + 1e-4));
        let speed = here.position.distance(next.position) / 1e-4;
        assert!((speed / true_speed - 1.0).abs() < 0.01, "speed {speed} at {t}");
        assert!((here.position.truncate().length() - 1000.0).abs() < 2.0);
        // The camera keeps its eye on the centre: an even turn stays even.
        let towards = -here.position.with_z(0.0).normalize();
        let forward = (here.attitude * DVec3::Y).with_z(0.0).normalize();
        assert!(forward.dot(towards) > 0.999_9, "at {t}");
    }
}

#[test]
fn the_height_never_leaves_the_range_of_its_two_keyframes() {
    let heights = [1000.0, 500.0, 500.0, 480.0, 2000.0, 1990.0];
    let keys: Vec<_> =
        heights.iter().enumerate().map(|(i, &z)| key(i as f64, 300.0 * i as f64, 0.0, z)).collect();
    let flight = flight(&keys);
    for step in 0..=500 {
        let t = f64::from(step) / 100.0;
        let i = (t.floor() as usize).min(4);
        let (low, high) = (heights[i].min(heights[i + 1]), heights[i].max(heights[i + 1]));
        let z = flight.pose_at(t).position.z;
        assert!((low - 1e-9..=high + 1e-9).contains(&z), "{z} at {t}");
    }
}

#[test]
fn equal_positions_at_different_times_are_a_hover() {
    let flight = flight(&[
        key(0.0, 0.0, 0.0, 10.0),
        key(1.0, 100.0, 0.0, 10.0),
        key(3.0, 100.0, 0.0, 10.0),
        key(4.0, 200.0, 50.0, 10.0),
    ]);
    for step in 0..=200 {
        let t = 1.0 + f64::from(step) / 100.0;
        assert_eq!(flight.pose_at(t).position, DVec3::new(100.0, 0.0, 10.0));
    }
}

#[test]
fn the_same_keyframe_twice_counts_once() {
    let once = [key(0.0, 0.0, 0.0, 0.0), key(1.0, 5.0, 3.0, 0.0), key(2.0, 9.0, 0.0, 0.0)];
    let twice = [once[0], once[1], once[1], once[2]];
    let mut opposite = twice;
    opposite[2].attitude = -opposite[2].attitude;
    for step in 0..=20 {
        let t = f64::from(step) / 10.0;
        assert_eq!(flight(&once).pose_at(t), flight(&twice).pose_at(t));
        assert_eq!(flight(&once).pose_at(t), flight(&opposite).pose_at(t));
    }
}

#[test]
fn another_pose_at_the_same_time_is_a_cut() {
    let flight = flight(&[
        key(0.0, 0.0, 0.0, 0.0),
        key(1.0, 10.0, 0.0, 0.0),
        key(1.0, 777.0, 0.0, 0.0),
        key(1.0, 500.0, 0.0, 0.0),
        key(2.0, 600.0, 0.0, 0.0),
    ]);
    assert!((flight.pose_at(1.0 - 1e-9).position.x - 10.0).abs() < 1e-6);
    assert_eq!(flight.pose_at(1.0).position.x, 500.0);
    assert!((flight.pose_at(1.5).position.x - 550.0).abs() < 1e-9);
    assert!((flight.pose_at(0.5).position.x - 5.0).abs() < 1e-9, "nothing is smoothed across it");
}

#[test]
fn a_cut_on_the_first_and_on_the_last_keyframe_shows_the_later_row() {
    let cut_first =
        flight(&[key(0.0, 1.0, 0.0, 0.0), key(0.0, 2.0, 0.0, 0.0), key(1.0, 3.0, 0.0, 0.0)]);
    assert_eq!(cut_first.pose_at(-1.0).position.x, 2.0);
    let cut_last =
        flight(&[key(0.0, 1.0, 0.0, 0.0), key(1.0, 2.0, 0.0, 0.0), key(1.0, 3.0, 0.0, 0.0)]);
    assert_eq!(cut_last.pose_at(1.0).position.x, 3.0);
    assert_eq!(cut_last.pose_at(5.0).position.x, 3.0);
}

#[test]
fn headings_turn_the_short_way_across_north() {
    let flight = flight(&[look(0.0, 350.0, 0.0, 0.0), look(1.0, 10.0, 0.0, 0.0)]);
    assert!(heading_deg(&flight.pose_at(0.5)).abs() < 1e-9);
    assert!((heading_deg(&flight.pose_at(0.25)) + 5.0).abs() < 1e-9);
}

#[test]
fn a_turn_of_exactly_180_degrees_goes_right() {
    for start in [0.0, 37.0, 90.0, 180.0, 271.5, 350.0] {
        for pitch in [0.0, -30.0, 60.0] {
            for back in [180.0, -180.0, 540.0] {
                let keys = [look(0.0, start, pitch, 0.0), look(1.0, start + back, pitch, 0.0)];
                let quarter = heading_deg(&flight(&keys).pose_at(0.25));
                let turned = (quarter - start).rem_euclid(360.0);
                assert!((turned - 45.0).abs() < 1e-6, "from {start} by {back}: {turned}");
            }
        }
    }
}

#[test]
fn a_half_turn_between_two_rests_goes_right_too() {
    let keys =
        [(0.0, 0.0), (1.0, 0.0), (2.0, 180.0), (3.0, 180.0)].map(|(t, h)| look(t, h, 0.0, 0.0));
    assert!((heading_deg(&flight(&keys).pose_at(1.5)) - 90.0).abs() < 1e-6);
    assert!(heading_deg(&flight(&keys).pose_at(0.7)).abs() < 1e-9);
}

#[test]
fn a_half_roll_puts_the_right_side_down_and_a_half_loop_lifts_the_nose() {
    let roll = flight(&[look(0.0, 0.0, 0.0, 0.0), look(1.0, 0.0, 0.0, 180.0)]).pose_at(0.5);
    assert!((roll.attitude * DVec3::X).z < -0.999_999);
    let back_over = look(1.0, 180.0, 0.0, 180.0);
    let nose = flight(&[look(0.0, 0.0, 0.0, 0.0), back_over]).pose_at(0.5);
    assert!((nose.attitude * DVec3::Y).z > 0.999_999);
}

#[test]
fn nothing_spins_when_the_camera_pitches_through_straight_down() {
    let keys =
        [look(0.0, 0.0, -80.0, 0.0), look(1.0, 0.0, -90.0, 0.0), look(2.0, 180.0, -80.0, 180.0)];
    let flight = flight(&keys);
    let mut before = flight.pose_at(0.0).attitude;
    for step in 1..=200 {
        let now = flight.pose_at(f64::from(step) / 100.0).attitude;
        assert!(before.angle_between(now).to_degrees() < 1.0, "at step {step}");
        before = now;
    }
}

#[test]
fn a_pose_looks_where_the_angles_say() {
    for (h, p, r) in [(0.0, 0.0, 0.0), (50.0, -80.0, 0.0), (271.0, 12.0, -33.0), (10.0, -90.0, 0.0)]
    {
        let place = DVec3::new(5e5, 5e6, 900.0);
        let keyframe = Keyframe::from_angles(0.0, place, h, p, r, 47.0);
        let camera = flight(&[keyframe]).pose_at(0.0).camera((640, 480));
        let expected = Camera::from_angles(place, h, p, r, 47.0, (640, 480));
        assert!(camera.is_valid());
        assert!((camera.forward - expected.forward).length() < 1e-14);
        assert!((camera.right - expected.right).length() < 1e-14);
        assert_eq!(camera.tan_half_hfov, expected.tan_half_hfov);
    }
}

#[test]
fn frames_run_from_the_first_keyframe_to_the_last_inclusive() {
    let flight = flight(&[key(10.0, 0.0, 0.0, 0.0), key(10.1, 1.0, 0.0, 0.0)]);
    let times: Vec<_> = flight.frame_times(30.0).unwrap().collect();
    assert_eq!(times.len(), 4);
    assert_eq!((times[0], times[3]), (10.0, 10.1));
    assert_eq!(flight.frame_times(1.0).unwrap().len(), 1);
    for fps in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(flight.frame_times(fps).err().unwrap(), FlightError::FrameRate(_)));
    }
    let far = self::flight(&[key(0.0, 0.0, 0.0, 0.0), key(1e9, 1.0, 0.0, 0.0)]);
    assert!(matches!(far.frame_times(60.0).err().unwrap(), FlightError::TooManyFrames { .. }));
}

#[test]
fn what_is_not_a_flight_is_refused_with_the_keyframe() {
    assert_eq!(Flight::new(vec![]).unwrap_err(), FlightError::Empty);
    let back = Flight::new(vec![
        key(0.0, 0.0, 0.0, 0.0),
        key(2.0, 0.0, 0.0, 0.0),
        key(1.0, 0.0, 0.0, 0.0),
    ]);
    assert!(matches!(back.unwrap_err(), FlightError::NotAscending { index: 2, .. }));
    let good = key(0.0, 0.0, 0.0, 0.0);
    for bad in [
        Keyframe { t_s: f64::NAN, ..good },
        Keyframe { position: DVec3::new(0.0, f64::INFINITY, 0.0), ..good },
        Keyframe { position: DVec3::new(0.0, f64::NAN, 0.0), ..good },
        Keyframe { attitude: DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), ..good },
        Keyframe { attitude: DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0), ..good },
        Keyframe { hfov_deg: 0.0, ..good },
        Keyframe { hfov_deg: f64::NAN, ..good },
    ] {
        let error = Flight::new(vec![good, bad]).unwrap_err();
        assert!(matches!(error, FlightError::OutOfRange { index: 1, .. }), "{error}");
    }
}

/// Keyframes as wild as the limits allow, times mostly ascending by odd steps.
fn wild() -> impl Strategy<Value = Vec<Keyframe>> {
    let step = prop_oneof![3 => 1e-5..100.0f64, 1 => Just(0.0), 1 => Just(2e-6), 1 => Just(1e5)];
    let place = prop_oneof![
        3 => (-1e4..1e4f64, -1e4..1e4f64, 0.0..5e3f64),
        1 => Just((0.0, 0.0, 100.0)),
        1 => (-1e9..1e9f64, -1e9..1e9f64, -1e9..1e9f64),
    ];
    let angle = prop_oneof![2 => -180.0..180.0f64, 1 => (-4..=4).prop_map(|q| f64::from(q) * 90.0)];
    let pitch = prop_oneof![2 => -90.0..90.0f64, 1 => Just(-90.0), 1 => Just(90.0)];
    let keyframe = (step, place, angle.clone(), pitch, angle, 1.0..=170.0f64);
    prop::collection::vec(keyframe, 1..12).prop_map(|rows| {
        let mut t = -50.0;
        let place = |(x, y, z)| DVec3::new(x, y, z);
        rows.into_iter()
            .map(|(step, at, h, p, r, fov)| {
                t += step;
                Keyframe::from_angles(t, place(at), h, p, r, fov)
            })
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn every_pose_is_finite_a_rotation_and_in_range(keys in wild(), shares in prop::collection::vec(-0.1..1.1f64, 30)) {
        let flight = flight(&keys);
        for share in shares {
            let pose = flight.pose_at(flight.start_s() + flight.duration_s() * share);
            prop_assert!(pose.position.is_finite());
            prop_assert!((pose.attitude.length() - 1.0).abs() < 1e-12);
            prop_assert!((MIN_HFOV_DEG..=MAX_HFOV_DEG).contains(&pose.hfov_deg));
            prop_assert!(pose.camera((640, 360)).is_valid());
        }
    }

    #[test]
    fn every_flight_passes_through_its_keyframes(keys in wild()) {
        let flight = flight(&keys);
        for (i, keyframe) in keys.iter().enumerate() {
            let is_seen = keys.get(i + 1).is_none_or(|next| next.t_s - keyframe.t_s > 1e-5);
            let is_on_time = i == 0 || keyframe.t_s - keys[i - 1].t_s > 1e-5 || keyframe.t_s == keys[i - 1].t_s;
            if is_seen && is_on_time {
                let pose = flight.pose_at(keyframe.t_s);
                prop_assert_eq!(pose.position, keyframe.position);
                prop_assert_eq!(pose.hfov_deg, keyframe.hfov_deg);
                prop_assert!(pose.attitude.dot(keyframe.attitude).abs() > 1.0 - 1e-12);
            }
        }
    }

    #[test]
    fn height_and_field_of_view_are_monotone_between_keyframes(keys in wild()) {
        let flight = flight(&keys);
        for pair in keys.windows(2) {
            let step = pair[1].t_s - pair[0].t_s;
            if step <= 1e-5 { continue; }
            let poses: Vec<_> = (0..50).map(|i| flight.pose_at(pair[0].t_s + step * f64::from(i) / 50.0)).collect();
            let (rises, widens) = (pair[1].position.z >= poses[0].position.z, pair[1].hfov_deg >= poses[0].hfov_deg);
            for two in poses.windows(2) {
                let (dz, df) = (two[1].position.z - two[0].position.z, two[1].hfov_deg - two[0].hfov_deg);
                prop_assert!(if rises { dz >= -1e-6 } else { dz <= 1e-6 }, "{dz}");
                prop_assert!(if widens { df >= -1e-9 } else { df <= 1e-9 }, "{df}");
            }
        }
    }

    #[test]
    fn no_step_turns_faster_than_nine_times_its_segment(keys in wild()) {
        let flight = flight(&keys);
        for segment in &flight.segments {
            let whole = turn::short_way(segment.from.attitude, segment.to.attitude).length();
            let mut before = segment.turn.at(0.0);
            for i in 1..=100 {
                let now = segment.turn.at(f64::from(i) / 100.0);
                let angle = 2.0 * libm::acos((before.dot(now).abs()).min(1.0));
                prop_assert!(angle <= 9.0 * whole / 100.0 + 1e-6, "{} of {}", angle, whole);
                before = now;
            }
        }
    }

    #[test]
    fn the_velocity_and_the_rate_of_turn_are_continuous(keys in wild()) {
        let flight = flight(&keys);
        for pair in flight.segments.windows(2) {
            let is_cut = pair[0].length_s == 0.0 || pair[1].from != pair[0].to;
            if is_cut { continue; }
            prop_assert_eq!(pair[0].velocity[1], pair[1].velocity[0]);
            prop_assert_eq!(pair[0].hfov_rate[1], pair[1].hfov_rate[0]);
            let small = 1e-6;
            let rate = |segment: &Segment, from: f64, to: f64| {
                let turned = turn::short_way(segment.turn.at(from), segment.turn.at(to));
                turned / (small * segment.length_s)
            };
            let (end, start) = (rate(&pair[0], 1.0 - small, 1.0), rate(&pair[1], 0.0, small));
            let scale = 1.0 / pair[0].length_s + 1.0 / pair[1].length_s;
            prop_assert!((end - start).length() <= 1e-3 * scale, "{} {}", end, start);
        }
    }

    #[test]
    fn backwards_the_camera_is_in_the_same_places(keys in wild(), shares in prop::collection::vec(0.0..1.0f64, 20)) {
        // Cuts are not symmetric: the later row wins. Spread the rows out in time.
        let spread = |(i, k): (usize, &Keyframe)| Keyframe { t_s: k.t_s + 0.01 * i as f64, ..*k };
        let keys: Vec<_> = keys.iter().enumerate().map(spread).collect();
        let forwards = flight(&keys);
        let reversed: Vec<_> = keys.iter().rev().map(|k| Keyframe { t_s: -k.t_s, ..*k }).collect();
        let backwards = flight(&reversed);
        for share in shares {
            let t = forwards.start_s() + forwards.duration_s() * share;
            let (one, other) = (forwards.pose_at(t), backwards.pose_at(-t));
            let size = 1.0 + one.position.length();
            prop_assert!(one.position.distance(other.position) <= 1e-6 * size);
            prop_assert!((one.hfov_deg - other.hfov_deg).abs() <= 1e-6);
        }
    }
}
