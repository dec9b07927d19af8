use glam::DVec3;
use std::collections::BTreeMap;
use std::sync::Arc;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_raycast::{Pyramid, View, render};
use terrafarm_terrain::codec::{decode, encode_heights};
use terrafarm_terrain::layout::*;
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::message::{Grant, OpenShot};

/// Size of every frame, pixels.
pub const SIZE: (u32, u32) = (96, 64);

/// Two by two tiles of hills, with the level above them.
pub struct Terrain {
    pub index: Arc<StoreIndex>,
    pub index_hash: BlobHash,
    pub blobs: BTreeMap<BlobHash, Vec<u8>>,
}

fn height(x: i64, y: i64) -> f32 {
    let (x, y) = (x.clamp(0, 512), y.clamp(0, 512));
    let ridge = (x / 7 % 23 - 11).abs() * 4 + (y / 5 % 17 - 8).abs() * 3;
    (ridge + x * y / 4096) as f32
}

impl Terrain {
    pub fn new() -> Self {
        let mut blobs = BTreeMap::new();
        let mut layer = Layer {
            kind: LayerKind::Height,
            origin: [0.0, 0.0],
            spacing: [10.0, 10.0],
            posts: [513, 513],
            levels: Vec::new(),
        };
        for level in 0..Layer::level_count(layer.posts) {
            let tiles = Layer::tiles_for(layer.level_posts(level));
            let places = (0..tiles[1]).flat_map(|ty| (0..tiles[0]).map(move |tx| (tx, ty)));
            let entries = places.map(|place| tile(level, place, &mut blobs)).collect();
            layer.levels.push(Level { tiles, entries });
        }
        let index = StoreIndex {
            version: STORE_VERSION,
            crs: "LOCAL".to_owned(),
            height_datum: HeightDatum::Unknown,
            earth_radius_m: None,
            layers: vec![layer],
            report: ImportReport::default(),
        };
        index.check().unwrap();
        let bytes = postcard::to_stdvec(&index).unwrap();
        let index_hash = hash_of(&bytes);
        blobs.insert(index_hash, bytes);
        Terrain { index: Arc::new(index), index_hash, blobs }
    }

    pub fn open(&self, shot: u64, samples_per_side: u32) -> OpenShot {
        OpenShot {
            shot: ShotId(shot),
            index: self.index_hash,
            shading: shading(),
            quality: Quality { samples_per_side, ..Quality::default() },
            check: Share::NONE,
            width: SIZE.0,
            height: SIZE.1,
            live: false,
        }
    }

    /// What a job must look like: rendered here, with everything in memory.
    pub fn expected(&self, grant: &Grant, samples_per_side: u32) -> Vec<u8> {
        let mut resident = Resident::new(self.index.clone());
        for (level, grid) in self.index.layers[0].levels.iter().enumerate() {
            for (at, entry) in grid.entries.iter().enumerate() {
                let (tx, ty) = (at as u32 % grid.tiles[0], at as u32 / grid.tiles[0]);
                let key = TileKey { layer: 0, level: level as u16, tx, ty };
                assert!(resident.insert(key, decode(&self.blobs[&entry.hash]).unwrap()));
            }
        }
        let quality = Quality { samples_per_side, ..Quality::default() };
        let view = View { camera: grant.camera, shading: shading(), quality };
        let rendered = render(&resident, &Pyramid::new(&self.index), &view, grant.region).unwrap();
        assert!(rendered.missing.is_empty());
        assert!(rendered.stats.hits > 0, "the test sees the ground");
        rendered.pixels
    }
}

fn tile(level: usize, (tx, ty): (u32, u32), blobs: &mut BTreeMap<BlobHash, Vec<u8>>) -> TileEntry {
    let side = TILE_POSTS as i64;
    let post = |at: i64| {
        let (i, j) = (at % side - 1, at / side - 1);
        let (i, j) = (i + i64::from(tx) * 256, j + i64::from(ty) * 256);
        height(i << level, j << level)
    };
    let posts: Vec<f32> = (0..side * side).map(post).collect();
    let bytes = encode_heights(&posts, Some(1.0));
    let hash = hash_of(&bytes);
    let length = bytes.len() as u32;
    blobs.insert(hash, bytes);
    // Bounds wider than the tile's own are allowed; they only cost steps.
    TileEntry { hash, offset: 4096, length, min: 0.0, max: 1000.0, deviation: 1000.0 }
}

fn shading() -> Shading {
    Shading {
        sun: Some(Sun::at(120.0, 40.0, 0.3, 1.0)),
        haze: None,
        sky: Sky::default(),
        earth: None,
        below_ground: [0.1; 3],
        bare_ground: None,
    }
}

pub fn grant(lease: u64, shot: u64, region: Region) -> Grant {
    let position = DVec3::new(2560.0, 300.0, 400.0);
    let camera = Camera::from_angles(position, 10.0, -12.0, 2.0, 70.0, SIZE);
    Grant { lease: LeaseId(lease), shot: ShotId(shot), frame: 0, region, camera }
}

pub fn whole() -> Region {
    Region::whole(SIZE.0, SIZE.1)
}
