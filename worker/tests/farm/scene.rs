use glam::DVec3;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_raycast::{Pyramid, View, render};
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::codec::decode;
use terrafarm_terrain::layout::*;
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::message::{Grant, OpenShot};

/// Size of every frame, pixels.
pub const SIZE: (u32, u32) = (96, 64);

/// Two by two tiles of hills, with the level above them.
pub struct Terrain {
    pub index: Arc<StoreIndex>,
    pub index_hash: BlobHash,
    pub blobs: BTreeMap<BlobHash, Vec<u8>>,
}

fn height(x: u64, y: u64) -> f32 {
    let (x, y) = (x as i64, y as i64);
    let ridge = (x / 7 % 23 - 11).abs() * 4 + (y / 5 % 17 - 8).abs() * 3;
    (ridge + x * y / 4096) as f32
}

struct Hills;

impl LayerSource for Hills {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        window.fill(into, height);
        Ok(())
    }
}

impl Terrain {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("hills.terrain");
        let spec = LayerSpec {
            kind: LayerKind::Height,
            origin: [0.0; 2],
            spacing: [10.0; 2],
            posts: [513; 2],
            quantum_m: Some(1.0),
        };
        let mut builder = StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, None).unwrap();
        builder.add_layer(spec, &Hills, &|_, _| (), &AtomicBool::new(false)).unwrap();
        builder.finish(ImportReport::default()).unwrap();
        let store = StoreReader::open(&path).unwrap();
        let (index_hash, bytes) = store.index_blob();
        let tiles = store.index().layers[0].levels.iter().flat_map(|level| &level.entries);
        let mut blobs: BTreeMap<_, _> =
            tiles.map(|tile| (tile.hash, store.read_blob(&tile.hash).unwrap())).collect();
        blobs.insert(index_hash, bytes.to_vec());
        Terrain { index: store.index().clone(), index_hash, blobs }
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
