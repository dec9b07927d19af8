//! Values and pure maths that every part of the farm shares.
//!
//! Nothing here knows a network, a file, a clock or a thread. Coordinates follow one
//! convention everywhere: a *grid frame* in metres, `x` east, `y` north, `z` up, taken
//! from the projected reference system of a terrain store; positions are f64.

pub mod accuracy;
pub mod camera;
pub mod compare;
pub mod flight;
pub mod id;
pub mod image;
pub mod quality;
pub mod region;
pub mod shading;
pub mod stats;
