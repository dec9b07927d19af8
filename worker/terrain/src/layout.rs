//! What a store contains: layers, levels and tiles, and where each lies on the map.
//!
//! All grids count posts from the south-west corner: post (i, j) of level 0 lies at
//! `x = origin.x + i * spacing.x`, `y = origin.y + j * spacing.y` in the store's CRS,
//! metres. Post (i, j) of level l lies where post (i << l, j << l) of level 0 lies.
//!
//! The [`StoreIndex`] is itself a blob with a hash; that hash is the identity of the
//! store. A worker that has the index knows everything but the tiles.

use serde::{Deserialize, Serialize};
use terrafarm_common::id::BlobHash;

/// Version of the index and of the tile encoding. Another version is refused.
pub const STORE_VERSION: u32 = 1;
/// Cells along a side of a tile.
pub const TILE_CELLS: usize = 256;
/// log2 of that.
const TILE_BITS: usize = TILE_CELLS.ilog2() as usize;
/// Posts kept beyond the tile's own 257 on each side, so that slopes at its border
/// need no neighbour.
pub const TILE_RING: usize = 1;
/// Posts along a side of a tile as stored: −1 ..= 257.
pub const TILE_POSTS: usize = TILE_CELLS + 1 + 2 * TILE_RING;
/// The largest height of a post above or below the datum, metres. What lies beyond is
/// no terrain but a fill value that a file forgot to name; such a post is void.
pub const MAX_HEIGHT_M: f32 = 1e7;
/// The largest number of posts along a side of a layer: 2^26, 67 million.
pub const MAX_POSTS: u64 = 1 << 26;
/// The largest number of layers.
pub const MAX_LAYERS: usize = 64;
/// The largest number of tiles of one store, all layers and levels together.
pub const MAX_TILES: u64 = 1 << 24;

/// Everything about a store except the tiles themselves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoreIndex {
    /// [`STORE_VERSION`].
    pub version: u32,
    /// The metric system of the grid, as text that `terrafarm_geo::Crs::parse` reads;
    /// `LOCAL` for terrain that lies nowhere on Earth.
    pub crs: String,
    /// What the heights are measured from.
    pub height_datum: HeightDatum,
    /// Radius of curvature of the Earth at the centre of the store, metres: the Gaussian
    /// mean radius of the ellipsoid there. `None` for `LOCAL`.
    pub earth_radius_m: Option<f64>,
    /// The layers. Height layers first, coarsest first, so that among those that cover a
    /// place the last one is the surface; then photo layers in the same order.
    pub layers: Vec<Layer>,
    /// How the store was made, for people.
    pub report: ImportReport,
}

/// What heights are measured from. Never converted, only named: a store cannot know the
/// geoid, and a silent 50 m shift is the classic blunder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
pub enum HeightDatum {
    /// The file did not say.
    #[default]
    Unknown,
    /// Mean sea level by some geoid (EGM96, EGM2008, NAVD88, ...).
    Geoid,
    /// The ellipsoid of the CRS.
    Ellipsoid,
}

/// What the samples of a layer are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LayerKind {
    /// Heights in metres; a void post has no height.
    Height,
    /// sRGB colour with coverage; a post is the centre of a photo's pixel.
    Photo,
}

/// One pyramid of grids.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layer {
    /// Heights or colours.
    pub kind: LayerKind,
    /// Position of post (0, 0), the south-west one: x and y in the CRS, metres.
    pub origin: [f64; 2],
    /// Distance between posts along x and y, metres, both positive.
    pub spacing: [f64; 2],
    /// Number of posts along x and y of level 0, each at least 1.
    pub posts: [u64; 2],
    /// The levels, finest first. The last one has a single tile.
    pub levels: Vec<Level>,
}

/// One grid of a layer, cut into tiles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Level {
    /// Number of tiles along x and y.
    pub tiles: [u32; 2],
    /// The tiles, row by row from the south-west.
    pub entries: Vec<TileEntry>,
}

/// One tile as the index knows it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TileEntry {
    /// SHA-256 of the encoded tile. All zero for a tile without a single valid post (its
    /// ring left out), which has no bytes.
    pub hash: BlobHash,
    /// Position of the encoded tile in the store file, bytes.
    pub offset: u64,
    /// Length of the encoded tile, bytes; 0 for an empty tile.
    pub length: u32,
    /// Lowest height of the valid posts of the tile, its ring left out. Photos: 0.
    pub min: f32,
    /// Highest height of the valid posts of the tile, its ring left out. Photos: 0.
    pub max: f32,
    /// Height layers: a bound on the vertical distance between the bilinear surface of
    /// this tile and that of level 0 over the same ground, metres. Infinite where voids
    /// make the two incomparable.
    pub deviation: f32,
}

impl TileEntry {
    /// A tile in which nothing is valid.
    pub const EMPTY: TileEntry = TileEntry {
        hash: BlobHash([0; 32]),
        offset: 0,
        length: 0,
        min: f32::INFINITY,
        max: f32::NEG_INFINITY,
        deviation: 0.0,
    };

    /// Whether the tile has no bytes.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }
}

/// Names a tile of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TileKey {
    /// Index into [`StoreIndex::layers`].
    pub layer: u16,
    /// Index into [`Layer::levels`].
    pub level: u16,
    /// Column of the tile, from the west.
    pub tx: u32,
    /// Row of the tile, from the south.
    pub ty: u32,
}

/// A rectangle of posts of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PostWindow {
    /// First column, from the west.
    pub i0: u64,
    /// First row, from the south.
    pub j0: u64,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
}

/// How a store was made: shown by `terrafarm terrain info`, read by nobody else.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct ImportReport {
    /// One line an input: file name, format, size, CRS, what was done with it.
    pub inputs: Vec<String>,
    /// Oddities that a user should know of.
    pub warnings: Vec<String>,
    /// Largest vertical distance seen between the store and its inputs, metres, at the
    /// inputs' posts and halfway between them; 0 if every post was taken untouched.
    pub max_resampling_error_m: f64,
    /// Root mean square of the same.
    pub rms_resampling_error_m: f64,
    /// Number of level 0 posts that are void, all height layers.
    pub void_posts: u64,
    /// Program and version that made the store.
    pub made_by: String,
}

impl Layer {
    /// Number of levels that a layer of this size has: the last one fits one tile.
    pub fn level_count(posts: [u64; 2]) -> usize {
        let mut count = 1;
        while posts.iter().any(|&n| level_cells(n, count - 1) > TILE_CELLS as u64) {
            count += 1;
        }
        count
    }

    /// Number of posts along x and y of a level: the grid is extended by less than one
    /// coarse cell so that it covers level 0.
    pub fn level_posts(&self, level: usize) -> [u64; 2] {
        self.posts.map(|n| level_cells(n, level) + 1)
    }

    /// Number of tiles along x and y that a grid of so many posts needs: at least one.
    pub fn tiles_for(posts: [u64; 2]) -> [u32; 2] {
        posts.map(|n| (n - 1).div_ceil(TILE_CELLS as u64).max(1) as u32)
    }

    /// Distance between posts of a level along x and y, metres.
    pub fn level_spacing(&self, level: usize) -> [f64; 2] {
        let scale = (1u64 << level) as f64;
        self.spacing.map(|step| step * scale)
    }

    /// Position of the north-east post of level 0.
    pub fn far_corner(&self) -> [f64; 2] {
        [0, 1].map(|axis| self.origin[axis] + (self.posts[axis] - 1) as f64 * self.spacing[axis])
    }

    /// The coarsest level at which a tile of level 0 is a cell at least: the last one, but
    /// for layers of more than 65 537 posts a side. Its tiles are the *roots* of the layer:
    /// whoever has them has some ground everywhere.
    pub fn root_level(&self) -> usize {
        TILE_BITS.min(self.levels.len().saturating_sub(1))
    }

    /// The entry of a tile, if there is such a tile.
    pub fn entry(&self, level: usize, tx: u32, ty: u32) -> Option<&TileEntry> {
        let level = self.levels.get(level)?;
        if tx >= level.tiles[0] || ty >= level.tiles[1] {
            return None;
        }
        level.entries.get(ty as usize * level.tiles[0] as usize + tx as usize)
    }
}

/// Number of cells along a side at a level, for `n` posts at level 0.
fn level_cells(n: u64, level: usize) -> u64 {
    (n - 1).div_ceil(1 << level)
}

impl StoreIndex {
    /// The entry of a tile, if there is such a tile.
    pub fn entry(&self, key: TileKey) -> Option<&TileEntry> {
        self.layers.get(usize::from(key.layer))?.entry(usize::from(key.level), key.tx, key.ty)
    }

    /// The tiles of all layers at their [`Layer::root_level`] that hold anything.
    pub fn roots(&self) -> Vec<TileKey> {
        let mut roots = Vec::new();
        for (number, layer) in self.layers.iter().enumerate() {
            let level = layer.root_level();
            let Some(grid) = layer.levels.get(level) else { continue };
            for (at, _) in grid.entries.iter().enumerate().filter(|(_, entry)| !entry.is_empty()) {
                let (tx, ty) = (at as u32 % grid.tiles[0], at as u32 / grid.tiles[0]);
                roots.push(TileKey { layer: number as u16, level: level as u16, tx, ty });
            }
        }
        roots
    }

    /// The layers of one kind, with their indices.
    pub fn layers_of(&self, kind: LayerKind) -> impl Iterator<Item = (usize, &Layer)> {
        self.layers.iter().enumerate().filter(move |(_, layer)| layer.kind == kind)
    }

    /// Checks everything that the rest of the program relies on: version, limits, that
    /// every level has the tiles its size asks for, that numbers are finite. Says what is
    /// wrong in words.
    pub fn check(&self) -> Result<(), String> {
        if self.version != STORE_VERSION {
            return Err(format!(
                "the store has version {}, this program reads version {STORE_VERSION}",
                self.version
            ));
        }
        if self.layers.len() > MAX_LAYERS {
            return Err(format!("{} layers; at most {MAX_LAYERS} are allowed", self.layers.len()));
        }
        if !self.layers.iter().any(|layer| layer.kind == LayerKind::Height) {
            return Err("the store has no heights".into());
        }
        if self.earth_radius_m.is_some_and(|radius| !(1e5..1e8).contains(&radius)) {
            return Err("the radius of the Earth is out of range".into());
        }
        let errors = [self.report.max_resampling_error_m, self.report.rms_resampling_error_m];
        if !errors.iter().all(|error| (0.0..=f64::MAX).contains(error)) {
            return Err("a resampling error of its report is out of range".into());
        }
        let mut tiles = 0;
        for (number, layer) in self.layers.iter().enumerate() {
            layer.check().map_err(|why| format!("layer {number}: {why}"))?;
            tiles += layer.levels.iter().map(|level| level.entries.len() as u64).sum::<u64>();
        }
        if tiles > MAX_TILES {
            return Err(format!("{tiles} tiles; at most {MAX_TILES} are allowed"));
        }
        Ok(())
    }
}

impl Layer {
    fn check(&self) -> Result<(), String> {
        let finite = self.origin.iter().chain(&self.spacing).all(|value| value.is_finite());
        if !finite || self.spacing.iter().any(|&step| step <= 0.0) {
            return Err("origin or spacing is not a number".into());
        }
        if self.posts.iter().any(|&n| n == 0 || n > MAX_POSTS) {
            return Err(format!("{} x {} posts is out of range", self.posts[0], self.posts[1]));
        }
        if self.far_corner().iter().any(|value| !value.is_finite()) {
            return Err("its far corner is out of range".into());
        }
        if self.levels.len() != Layer::level_count(self.posts) {
            return Err(format!("{} levels do not fit its size", self.levels.len()));
        }
        for (number, level) in self.levels.iter().enumerate() {
            let tiles = Layer::tiles_for(self.level_posts(number));
            let expected = u64::from(tiles[0]) * u64::from(tiles[1]);
            if level.tiles != tiles || level.entries.len() as u64 != expected {
                return Err(format!("level {number} has the wrong number of tiles"));
            }
            let sound = |e: &TileEntry| match e.is_empty() {
                true => *e == TileEntry::EMPTY,
                false => {
                    let bounds = -MAX_HEIGHT_M <= e.min && e.min <= e.max && e.max <= MAX_HEIGHT_M;
                    bounds && e.deviation >= 0.0
                }
            };
            if !level.entries.iter().all(sound) {
                return Err(format!("level {number} has a bound that is out of range"));
            }
        }
        Ok(())
    }
}
