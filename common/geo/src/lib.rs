//! Coordinate reference systems: positions between longitude/latitude and a store's
//! metric grid.
//!
//! [`Crs`] is one system, read from what files and users write ("EPSG:32612", proj
//! strings, the WKT of `.prj` files). [`Transformer`] carries points from one to another.
//!
//! Conventions. Positions are `[x, y]`, x to the east and y to the north; for a
//! geographic system `[longitude, latitude]` in degrees, whatever order the authority
//! prefers. Longitude and latitude without further words are those of WGS84.
//!
//! Limits. Projections and Helmert shifts come from proj4rs, which follows PROJ 4:
//! - WGS84, NAD83, ETRS89, GDA94/2020, NZGD2000 and their like count as one datum; they
//!   differ by up to about 2 m.
//! - There are no datum grids. Old datums are shifted by three or seven parameters, good
//!   to some 1-10 m, and [`Crs::warnings`] says so.
//! - Heights are never touched.
//!
//! The functions use the platform's sine and cosine. They place terrain when it is
//! imported and cameras when a flight is planned, both once and on one machine; nothing
//! that runs for every pixel may call them.

mod crs;
mod datum;
mod proj_string;
mod transform;
mod wkt;
mod zones;

pub use crs::{Crs, CrsError, gaussian_radius_m};
pub use transform::Transformer;
