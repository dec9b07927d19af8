//! Flights: keyframes and the smooth path through them.
//!
//! A [`Flight`] passes through every keyframe at its time. Between them
//!
//! - the horizontal position is a C1 cubic whose tangents are those of the C2 spline,
//!   limited so that it neither loops nor backs up at a sharp turn ([`spline`]);
//! - the height and the field of view are such cubics of their own, monotone between
//!   two keyframes: the camera never dips below the lower of its neighbours;
//! - the attitude turns the short way by a C1 curve of quaternions ([`turn`]), so that
//!   pitch +-90 degrees is an attitude like any other. Between keyframes that differ in
//!   heading *and* pitch the horizon may tilt a little, as it does on any shortest turn.
//!
//! What is odd has one meaning:
//!
//! - one keyframe is a still; before the first and after the last the camera rests;
//! - the same keyframe twice counts once; another pose at the same time is a *cut*: the
//!   later row is what is seen from that time on, and nothing is smoothed across it.
//!   Times within [`SAME_TIME_S`] are the same;
//! - equal positions at different times are a hover: the camera stands still;
//! - a keyframe at which neither speed nor course changes keeps that velocity, so a
//!   straight leg at constant speed stays one, whatever comes before and after it;
//! - a turn of exactly 180 degrees goes right (clockwise from above); if it turns about
//!   a level axis, it rolls the right side down, or else lifts the nose.
//!
//! Run backwards, position and field of view take the same path; the attitude does so
//! where it turns about one axis.

mod spline;
mod turn;

use crate::camera::{self, Camera, MAX_HFOV_DEG, MIN_HFOV_DEG};
use glam::{DMat3, DQuat, DVec3};
use spline::{Knots, hermite};
use turn::Turn;

/// Keyframes closer in time than this, seconds, are at the same time.
pub const SAME_TIME_S: f64 = 1e-6;
/// The largest number of keyframes: a logger's 10 Hz for 27 hours.
pub const MAX_KEYFRAMES: usize = 1_000_000;
/// The largest number of frames of one flight: 46 hours at 60 a second.
pub const MAX_FRAMES: u32 = 10_000_000;
/// The largest time of a keyframe, seconds either side of 0; Unix times fit.
pub const MAX_TIME_S: f64 = 1e10;
/// The largest coordinate of a keyframe, metres.
pub const MAX_POSITION_M: f64 = 1e9;

/// What a flight asks of the camera at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Time, seconds; the first keyframe of a flight need not be at 0.
    pub t_s: f64,
    /// Position, metres; any linear frame with `z` up.
    pub position: DVec3,
    /// Rotation from camera axes (x right, y forward, z up) to that frame; unit length.
    pub attitude: DQuat,
    /// Horizontal field of view, degrees.
    pub hfov_deg: f64,
}

impl Keyframe {
    /// A keyframe from flight angles, with the signs of [`Camera::from_angles`].
    pub fn from_angles(
        t_s: f64,
        position: DVec3,
        heading_deg: f64,
        pitch_deg: f64,
        roll_deg: f64,
        hfov_deg: f64,
    ) -> Self {
        let frame = camera::attitude(heading_deg, pitch_deg, roll_deg);
        Keyframe { t_s, position, attitude: DQuat::from_mat3(&frame).normalize(), hfov_deg }
    }

    fn pose(&self) -> Pose {
        Pose { position: self.position, attitude: self.attitude, hfov_deg: self.hfov_deg }
    }

    /// Opposite quaternions are the same attitude.
    fn is_same_pose(&self, other: &Keyframe) -> bool {
        self.position == other.position
            && self.hfov_deg == other.hfov_deg
            && (self.attitude == other.attitude || self.attitude == -other.attitude)
    }
}

/// Where the camera is, where it looks and how wide, at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Position in the frame of the keyframes, metres.
    pub position: DVec3,
    /// Rotation from camera axes (x right, y forward, z up) to that frame.
    pub attitude: DQuat,
    /// Horizontal field of view, degrees.
    pub hfov_deg: f64,
}

impl Pose {
    /// The camera that takes a picture of this width and height, pixels, from here.
    pub fn camera(&self, (width, height): (u32, u32)) -> Camera {
        let frame = DMat3::from_quat(self.attitude);
        Camera {
            position: self.position,
            right: frame.x_axis,
            up: frame.z_axis,
            forward: frame.y_axis,
            tan_half_hfov: libm::tan(self.hfov_deg.to_radians() / 2.0),
            width,
            height,
        }
    }
}

/// Why keyframes are not a flight. Keyframes are counted from 0.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FlightError {
    /// There is nothing to fly.
    #[error("a flight has no keyframes; give at least one")]
    Empty,
    /// More keyframes than [`MAX_KEYFRAMES`].
    #[error("a flight has {0} keyframes, more than {MAX_KEYFRAMES}; thin it out or cut it")]
    TooManyKeyframes(usize),
    /// A number is NaN, infinite or beyond its limit.
    #[error("keyframe {index}: {what} is out of range; {allowed}")]
    OutOfRange {
        /// Which keyframe.
        index: usize,
        /// Which value of it.
        what: &'static str,
        /// What it may be.
        allowed: &'static str,
    },
    /// A keyframe is earlier than the one before it.
    #[error(
        "keyframe {index}: its time {t_s} s is before that of the one above it, {previous_s} s; sort the keyframes by time"
    )]
    NotAscending {
        /// Which keyframe.
        index: usize,
        /// Its time, seconds.
        t_s: f64,
        /// The time of the keyframe before it, seconds.
        previous_s: f64,
    },
    /// A frame rate that is not a positive number.
    #[error("{0} frames per second is no frame rate; give a number above 0")]
    FrameRate(f64),
    /// More frames than [`MAX_FRAMES`].
    #[error(
        "a flight of {duration_s} s at {fps} frames per second has more than {MAX_FRAMES} frames; cut the flight or lower the rate"
    )]
    TooManyFrames {
        /// Length of the flight, seconds.
        duration_s: f64,
        /// Frames per second.
        fps: f64,
    },
}

/// A smooth path through keyframes.
#[derive(Debug, Clone)]
pub struct Flight {
    keyframes: Vec<Keyframe>,
    /// In order of time; each holds from its start to the start of the next.
    segments: Vec<Segment>,
}

impl Flight {
    /// The flight through these keyframes, which are in order of time.
    pub fn new(mut keyframes: Vec<Keyframe>) -> Result<Self, FlightError> {
        check(&keyframes)?;
        for keyframe in &mut keyframes {
            keyframe.attitude = keyframe.attitude.normalize();
        }
        let segments = shots_between_cuts(&keyframes).iter().flat_map(|run| smooth(run)).collect();
        Ok(Flight { keyframes, segments })
    }

    /// The keyframes as given, attitudes normalised.
    pub fn keyframes(&self) -> &[Keyframe] {
        &self.keyframes
    }

    /// Time of the first keyframe, seconds.
    pub fn start_s(&self) -> f64 {
        self.keyframes[0].t_s
    }

    /// Time of the last keyframe, seconds.
    pub fn end_s(&self) -> f64 {
        self.keyframes[self.keyframes.len() - 1].t_s
    }

    /// Time from the first keyframe to the last, seconds.
    pub fn duration_s(&self) -> f64 {
        self.end_s() - self.start_s()
    }

    /// The pose at a time on the keyframes' own clock, seconds. Before the first keyframe
    /// it is the first, after the last the last; NaN counts as before the first.
    pub fn pose_at(&self, t_s: f64) -> Pose {
        let after = self.segments.partition_point(|segment| segment.start_s <= t_s);
        self.segments[after.saturating_sub(1)].pose_at(t_s)
    }

    /// The time of each frame, seconds: from the first keyframe in steps of 1 / `fps`, up
    /// to and including the last keyframe if a frame falls on it.
    pub fn frame_times(
        &self,
        fps: f64,
    ) -> Result<impl ExactSizeIterator<Item = f64> + Clone + use<>, FlightError> {
        if !(fps.is_finite() && fps > 0.0) {
            return Err(FlightError::FrameRate(fps));
        }
        let duration_s = self.duration_s();
        // A flight of 0.1 s at 30 a second has a frame on its end, rounding or not.
        let steps = (duration_s * fps + 1e-6).floor();
        if steps >= f64::from(MAX_FRAMES) {
            return Err(FlightError::TooManyFrames { duration_s, fps });
        }
        let (start_s, end_s) = (self.start_s(), self.end_s());
        let time_of = move |frame| (start_s + f64::from(frame) / fps).min(end_s);
        Ok((0..steps as u32 + 1).map(time_of))
    }
}

fn check(keyframes: &[Keyframe]) -> Result<(), FlightError> {
    if keyframes.is_empty() {
        return Err(FlightError::Empty);
    }
    if keyframes.len() > MAX_KEYFRAMES {
        return Err(FlightError::TooManyKeyframes(keyframes.len()));
    }
    for (index, keyframe) in keyframes.iter().enumerate() {
        let out_of_range = |what, allowed| Err(FlightError::OutOfRange { index, what, allowed });
        if !(-MAX_TIME_S..=MAX_TIME_S).contains(&keyframe.t_s) {
            return out_of_range("the time", "at most 1e10 s either side of 0");
        }
        if !(keyframe.position.is_finite()
            && keyframe.position.abs().max_element() <= MAX_POSITION_M)
        {
            return out_of_range("the position", "at most 1e9 m along each axis");
        }
        if !(1.0 - 1e-6..=1.0 + 1e-6).contains(&keyframe.attitude.length()) {
            return out_of_range("the attitude", "a quaternion of length 1");
        }
        if !(MIN_HFOV_DEG..=MAX_HFOV_DEG).contains(&keyframe.hfov_deg) {
            return out_of_range("the horizontal field of view", "1 to 170 degrees");
        }
    }
    for (index, pair) in keyframes.windows(2).enumerate() {
        if pair[1].t_s < pair[0].t_s {
            return Err(FlightError::NotAscending {
                index: index + 1,
                t_s: pair[1].t_s,
                previous_s: pair[0].t_s,
            });
        }
    }
    Ok(())
}

/// The keyframes in runs that are each smooth in themselves. Within a run every step is
/// longer than [`SAME_TIME_S`]; a pose that no time is left to see is dropped.
fn shots_between_cuts(keyframes: &[Keyframe]) -> Vec<Vec<Keyframe>> {
    let mut runs = vec![vec![keyframes[0]]];
    for keyframe in &keyframes[1..] {
        let run = runs.last_mut().expect("there is a run from the first keyframe on");
        let last = run[run.len() - 1];
        if keyframe.t_s - last.t_s > SAME_TIME_S {
            run.push(*keyframe);
        } else if !keyframe.is_same_pose(&last) {
            let cut = Keyframe { t_s: last.t_s, ..*keyframe };
            if run.len() == 1 {
                run[0] = cut;
            } else {
                runs.push(vec![cut]);
            }
        }
    }
    runs
}

/// The path from one keyframe to the next.
#[derive(Debug, Clone)]
struct Segment {
    start_s: f64,
    /// 0 for a keyframe at which the camera rests.
    length_s: f64,
    from: Pose,
    to: Pose,
    /// Velocity at the start and at the end, metres a second.
    velocity: [DVec3; 2],
    /// Change of the field of view at both ends, degrees a second.
    hfov_rate: [f64; 2],
    turn: Turn,
}

impl Segment {
    fn still(keyframe: &Keyframe) -> Self {
        Segment {
            start_s: keyframe.t_s,
            length_s: 0.0,
            from: keyframe.pose(),
            to: keyframe.pose(),
            velocity: [DVec3::ZERO; 2],
            hfov_rate: [0.0; 2],
            turn: Turn::still(keyframe.attitude),
        }
    }

    fn pose_at(&self, t_s: f64) -> Pose {
        let share = (t_s - self.start_s) / self.length_s;
        // NaN, from a time or from a still, is the start.
        if share.is_nan() || share <= 0.0 {
            return self.from;
        }
        if share >= 1.0 {
            return self.to;
        }
        let position =
            hermite(self.from.position, self.to.position, self.velocity, self.length_s, share);
        let splat = DVec3::splat;
        let hfov = hermite(
            splat(self.from.hfov_deg),
            splat(self.to.hfov_deg),
            self.hfov_rate.map(splat),
            self.length_s,
            share,
        );
        Pose {
            position,
            attitude: self.turn.at(share),
            hfov_deg: hfov.x.clamp(MIN_HFOV_DEG, MAX_HFOV_DEG),
        }
    }
}

/// The segments of a run of keyframes; one still segment if there is only one.
fn smooth(run: &[Keyframe]) -> Vec<Segment> {
    if run.len() == 1 {
        return vec![Segment::still(&run[0])];
    }
    let steps_s: Vec<f64> = run.windows(2).map(|pair| pair[1].t_s - pair[0].t_s).collect();
    let rates = |change: &dyn Fn(&Keyframe, &Keyframe) -> DVec3| -> Vec<DVec3> {
        let slopes = run.windows(2).zip(&steps_s).map(|(pair, h)| change(&pair[0], &pair[1]) / *h);
        Knots { steps_s: &steps_s, slopes: &slopes.collect::<Vec<_>>() }.tangents()
    };
    let level = rates(&|a, b| (b.position - a.position).with_z(0.0));
    let climb = rates(&|a, b| DVec3::Z * (b.position.z - a.position.z));
    let zoom = rates(&|a, b| DVec3::X * (b.hfov_deg - a.hfov_deg));
    let turns = rates(&|a, b| turn::short_way(a.attitude, b.attitude));
    let segment = |i: usize| Segment {
        start_s: run[i].t_s,
        length_s: steps_s[i],
        from: run[i].pose(),
        to: run[i + 1].pose(),
        velocity: [level[i] + climb[i], level[i + 1] + climb[i + 1]],
        hfov_rate: [zoom[i].x, zoom[i + 1].x],
        turn: Turn::new(
            run[i].attitude,
            run[i + 1].attitude,
            [turns[i] * steps_s[i], turns[i + 1] * steps_s[i]],
        ),
    };
    (0..steps_s.len()).map(segment).collect()
}

#[cfg(test)]
mod tests;
