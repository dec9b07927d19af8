//! Tiles to pictures: what has arrived of each frame, and when it is whole.
//!
//! Results come from many workers in any order and any split. [`Film`] merges them, each
//! pixel exactly once, and hands a frame out when nothing is missing; [`OrderedFrames`]
//! puts whole frames back into the order of the flight. Nothing here knows workers,
//! leases or files, and every buffer has a limit that its owner chooses.
//!
//! ```
//! use terrafarm_common::region::Region;
//! use terrafarm_film::{Film, Merge, OrderedFrames};
//!
//! let mut film = Film::new(2);
//! film.open(0, 4, 1)?;
//! let left = Region { x: 0, y: 0, width: 3, height: 1 };
//! let right = Region { x: 3, y: 0, width: 1, height: 1 };
//! assert_eq!(film.merge(0, right, &[9; 3])?, Merge::Partial { missing_px: 3 });
//! let Merge::Complete(picture) = film.merge(0, left, &[7; 9])? else { unreachable!() };
//!
//! let mut frames = OrderedFrames::new(2);
//! frames.put(0, picture)?;
//! assert_eq!(frames.take().map(|(frame, picture)| (frame, picture.get(3, 0))), Some((0, [9; 3])));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod coverage;
mod film;
mod order;

pub use film::{Film, FilmError, Merge};
pub use order::{OrderError, OrderedFrames};
