//! Many rays of one view, cast together: abreast where that can be, else one by one.

use super::abreast::{Abreast, Sight};
use super::arc::Globe;
use super::rays::{Part, Rays, Verdict};
use super::tiles::Tiles;
use crate::field::{Contact, Cursor, Field, Ground, Outcome, corners_in, tile_key};
use crate::grid::cells_of;
use crate::lanes::{self, Width};
use crate::painter::{Caster, path};
use crate::path::{self, Path};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Method;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::LayerKind;

pub(crate) use super::rays::MOST_RAYS;

/// A list of rays with what they met.
pub(crate) struct Many<'a> {
    /// Casts what is not cast abreast.
    pub slow: Caster<'a>,
    camera: &'a Camera,
    ground: path::Ground,
    width: Width,
    abreast: Option<Layer<'a>>,
    cursor: Cursor<'a>,
    rays: Rays,
    /// Those that are not done at once.
    rest: Rays,
    /// What the slow caster found, by ray.
    outcomes: Vec<Outcome>,
    hits: u64,
    /// Blocks and cells looked at abreast.
    pub steps: u64,
}

/// The only height layer of a store.
struct Layer<'a> {
    number: usize,
    sight: Sight<'a>,
    tiles: Tiles<'a>,
}

impl<'a> Many<'a> {
    pub(crate) fn new(
        field: Field<'a>,
        camera: &'a Camera,
        ground: path::Ground,
        method: Method,
        width: Width,
    ) -> Self {
        let fast = !matches!(method, Method::Reference);
        Many {
            slow: Caster::new(field, method),
            camera,
            ground,
            width,
            abreast: if fast { Layer::new(field, camera, &ground) } else { None },
            cursor: Cursor::new(field),
            rays: Rays::new(),
            rest: Rays::new(),
            outcomes: vec![Outcome::Miss; MOST_RAYS],
            hits: 0,
            steps: 0,
        }
    }

    /// Forgets all rays.
    pub(crate) fn clear(&mut self) {
        self.rays.count = 0;
    }

    /// How many rays the list can take.
    pub(crate) fn room(&self) -> usize {
        MOST_RAYS - self.rays.count
    }

    /// Rays in the list.
    pub(crate) fn len(&self) -> usize {
        self.rays.count
    }

    /// Adds a ray through a point of the picture, known to meet nothing up to a depth.
    /// There must be room.
    #[inline]
    pub(crate) fn push(&mut self, place: [f64; 2], depth: f64) {
        let at = self.rays.count;
        self.rays.part_mut(Part::PlaceX)[at] = place[0];
        self.rays.part_mut(Part::PlaceY)[at] = place[1];
        self.rays.part_mut(Part::Depth)[at] = depth;
        self.rays.count = at + 1;
    }

    /// Adds the rays through the centres of pixels, row by row. There must be room.
    #[inline]
    pub(crate) fn push_centres(&mut self, pixels: Region, depth: f64) {
        /// Rays that are written at once: what is too much is written over, or is behind
        /// the last ray.
        const ABREAST: u32 = 4;
        let rays = &mut self.rays;
        for row in 0..pixels.height {
            let y = f64::from(pixels.y + row) + 0.5;
            let mut column = 0;
            while column < pixels.width {
                let at = rays.count;
                let x = f64::from(pixels.x + column) + 0.5;
                let end = at + ABREAST as usize;
                let places = &mut rays.part_mut(Part::PlaceX)[at..end];
                (0..ABREAST).zip(places).for_each(|(n, place)| *place = x + f64::from(n));
                rays.part_mut(Part::PlaceY)[at..end].fill(y);
                rays.part_mut(Part::Depth)[at..end].fill(depth);
                let taken = ABREAST.min(pixels.width - column);
                rays.count = at + taken as usize;
                column += taken;
            }
        }
    }

    /// Casts all rays of the list.
    pub(crate) fn cast(&mut self) {
        let count = self.rays.count;
        let any_open = match &mut self.abreast {
            Some(Layer { sight, tiles, .. }) => {
                let (rays, rest) = (&mut self.rays, &mut self.rest);
                let abreast = Abreast { sight: *sight, tiles, rays, rest };
                let tally = lanes::run(abreast, self.width);
                self.steps += tally.steps;
                self.hits = tally.hits;
                tally.any_open
            }
            None => {
                self.rays.verdicts[..count].fill(Verdict::Open as i32);
                self.hits = 0;
                true
            }
        };
        if any_open {
            self.cast_open();
        }
    }

    /// Casts those that could not be cast abreast.
    #[cold]
    fn cast_open(&mut self) {
        for ray in 0..self.rays.count {
            if self.rays.verdict(ray) == Verdict::Open {
                self.cast_slowly(ray);
            }
        }
    }

    fn cast_slowly(&mut self, ray: usize) {
        let (path, free_u) = self.path(ray);
        let outcome = self.slow.cast(&path, free_u);
        let directions = [Part::DirectionX, Part::DirectionY, Part::DirectionZ];
        for (axis, part) in directions.into_iter().enumerate() {
            self.rays.part_mut(part)[ray] = path.direction[axis];
        }
        self.rays.inverse_depths[ray] = match &outcome {
            Outcome::Hit(contact) => {
                self.hits += 1;
                self.rays.part_mut(Part::U)[ray] = contact.u;
                let along_axis = path.direction.dot(self.camera.forward);
                (1.0 / (contact.u * along_axis)) as f32
            }
            Outcome::Miss => 0.0,
            Outcome::Unfinished => f32::NAN,
        };
        self.outcomes[ray] = outcome;
    }

    /// A ray of the list, and the parameter up to which it is free.
    pub(crate) fn path(&self, ray: usize) -> (Path, f64) {
        let part = |part| self.rays.part(part)[ray];
        let place = [part(Part::PlaceX), part(Part::PlaceY)];
        path(self.camera, self.ground, place, part(Part::Depth))
    }

    /// The unit vector of a ray's direction at the camera, for a ray that met the surface.
    pub(crate) fn direction(&self, ray: usize) -> DVec3 {
        let part = |part| self.rays.part(part)[ray];
        DVec3::new(part(Part::DirectionX), part(Part::DirectionY), part(Part::DirectionZ))
    }

    /// Parameter of the path at which a ray met the surface.
    #[inline]
    pub(crate) fn parameter(&self, ray: usize) -> f64 {
        self.rays.part(Part::U)[ray]
    }

    /// Rays of the list that met the surface.
    pub(crate) fn hits(&self) -> u64 {
        self.hits
    }

    /// One over the depths of what some rays met, per metre; see [`crate::Depths`]. 0 for
    /// nothing, NaN if it cannot be told for want of a tile.
    #[inline]
    pub(crate) fn inverse_depths(&self, first: usize, count: usize) -> &[f32] {
        &self.rays.inverse_depths[first..first + count]
    }

    /// Whether a ray met the surface; `None` if it cannot be told for want of a tile.
    #[inline]
    pub(crate) fn is_hit(&self, ray: usize) -> Option<bool> {
        match self.rays.verdict(ray) {
            Verdict::Hit => Some(true),
            Verdict::Miss => Some(false),
            Verdict::Open => match self.outcomes[ray] {
                Outcome::Hit(_) => Some(true),
                Outcome::Miss => Some(false),
                Outcome::Unfinished => None,
            },
        }
    }

    /// What became of a ray.
    pub(crate) fn outcome(&mut self, ray: usize) -> Outcome {
        match self.rays.verdict(ray) {
            Verdict::Hit => self.contact(ray).map_or(Outcome::Miss, Outcome::Hit),
            Verdict::Miss => Outcome::Miss,
            Verdict::Open => self.outcomes[ray],
        }
    }

    /// The contact of a ray that was cast abreast.
    fn contact(&mut self, ray: usize) -> Option<Contact> {
        let Layer { number, sight, .. } = self.abreast.as_ref()?;
        let cell = [0, 1].map(|axis| self.rays.cells[axis][ray]);
        let Ground::Loaded(tile) = self.cursor.ground(tile_key(*number, cell)) else {
            return None;
        };
        let corners = corners_in(tile, cell)?;
        let u = self.rays.part(Part::U)[ray];
        let rate = [Part::RateX, Part::RateY].map(|part| self.rays.part(part)[ray]);
        let place = [0, 1].map(|axis| {
            (sight.start[axis] + u * rate[axis] - f64::from(cell[axis])).clamp(0.0, 1.0)
        });
        let z = self.rays.part(Part::Z)[ray];
        Some(Contact { layer: *number, cell, u, z, place, corners })
    }
}

impl<'a> Layer<'a> {
    /// `None` if the store has more than one height layer, or none with cells.
    fn new(field: Field<'a>, camera: &'a Camera, ground: &path::Ground) -> Option<Self> {
        let mut layers = field.index().layers_of(LayerKind::Height);
        let (number, layer) = layers.next()?;
        let cells = cells_of(layer);
        if layers.next().is_some() || cells.contains(&0) {
            return None;
        }
        let scale = layer.spacing.map(|spacing| 1.0 / spacing);
        let eye = camera.position;
        let start = [0, 1].map(|axis| (eye[axis] - layer.origin[axis]) * scale[axis]);
        let slack = [0, 1].map(|axis| {
            let largest = 1.0 + start[axis].abs() + f64::from(cells[axis]);
            16.0 * f64::EPSILON * largest
        });
        let sight = Sight {
            camera,
            globe: (ground.curvature() != 0.0).then(|| Globe::new(ground, eye.z)),
            start,
            slack,
            scale,
            cells,
            highest: field.pyramid.highest(),
            largest: field.pyramid.highest().abs().max(field.pyramid.lowest().abs()),
        };
        Some(Layer { number, sight, tiles: Tiles::new(field, number) })
    }
}
