//! A worker's terrain cache over a store on this PC: what is asked for is loaded, within
//! the limit, and counted.

use anyhow::bail;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::region::Region;
use terrafarm_raycast::meter::measure;
use terrafarm_raycast::{Depths, Missing, Pyramid, Unseen, View, depths};
use terrafarm_terrain::codec;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::StoreReader;
use terrafarm_worker::RayCaster;
use terrafarm_worker::office::Gate;
use terrafarm_worker::render::{Check, Job, Outcome, Picture, Scene};
use terrafarm_worker::terrain::Terrain;

/// The cache, and what has gone through it.
pub struct Cache<'s> {
    store: &'s StoreReader,
    id: BlobHash,
    terrain: Terrain<Pyramid>,
    /// Tiles that were asked for, each once.
    pub touched: BTreeSet<TileKey>,
    /// Tiles that were loaded, those that came back included.
    pub loads: u64,
    /// Time for reading, checking and unpacking them, seconds.
    pub load_s: f64,
    /// Most bytes that decoded tiles took at once.
    pub peak_bytes: u64,
}

impl<'s> Cache<'s> {
    /// An empty one, for this many bytes of decoded tiles.
    pub fn new(store: &'s StoreReader, limit_bytes: u64) -> Self {
        let id = store.index_blob().0;
        let mut terrain = Terrain::new(limit_bytes);
        let index = store.index();
        terrain.add_store(id, Resident::new(index.clone()), Pyramid::new(index));
        Cache { store, id, terrain, touched: BTreeSet::new(), loads: 0, load_s: 0.0, peak_bytes: 0 }
    }

    /// A new frame begins: tiles of the one before may go.
    pub fn begin(&mut self) {
        self.terrain.begin_job(ShotId(0), 0);
    }

    fn scene(&self) -> anyhow::Result<Scene<Pyramid>> {
        self.terrain.scene(self.id).ok_or_else(|| anyhow::anyhow!("the store is not in memory"))
    }

    fn load(&mut self, keys: &[TileKey]) -> anyhow::Result<()> {
        let began = Instant::now();
        let hashes = self.terrain.await_tiles(self.id, keys);
        if hashes.is_empty() {
            bail!("the ray caster asks for tiles that the store does not have: {keys:?}");
        }
        for hash in hashes {
            let tile = codec::decode(&self.store.read_blob(&hash)?)?;
            self.terrain.add_tile(hash, &tile).map_err(anyhow::Error::msg)?;
            self.loads += 1;
            if let Some(why) = self.terrain.over_limit() {
                bail!("{}: {why}", self.store.path().display());
            }
            self.peak_bytes = self.peak_bytes.max(self.terrain.bytes());
        }
        self.touched.extend(keys);
        self.load_s += began.elapsed().as_secs_f64();
        Ok(())
    }

    /// The distances of a whole picture.
    pub fn depths(&mut self, view: &View) -> anyhow::Result<Depths> {
        let frame = Region::whole(view.camera.width, view.camera.height);
        loop {
            let scene = self.scene()?;
            match depths(&scene.resident, &scene.prepared, view, frame) {
                Ok(depths) => return Ok(depths),
                Err(Unseen::Unfit(unfit)) => return Err(unfit.into()),
                Err(Unseen::Missing(keys)) => {
                    // Or the tiles would be copied where they change.
                    drop(scene);
                    self.load(&keys)?;
                }
            }
        }
    }

    /// A whole picture as a worker makes it, on the thread pool that this is called on.
    pub fn picture(&mut self, view: &View) -> anyhow::Result<Picture> {
        let frame = Region::whole(view.camera.width, view.camera.height);
        let stop = Arc::new(AtomicBool::new(false));
        let job = Job::new(&RayCaster, LeaseId(0), view.clone(), frame, Check::default(), stop);
        let mut job = Box::new(job);
        let gate = Gate::new(rayon::current_num_threads());
        loop {
            let scene = self.scene()?;
            let outcome = job.advance(&RayCaster, &scene, &gate).map_err(anyhow::Error::msg)?;
            drop(scene);
            match outcome {
                Outcome::Done(picture) => return Ok(picture),
                Outcome::Stopped => bail!("nobody asked to stop"),
                Outcome::Missing(rest, keys) => {
                    self.load(&keys)?;
                    job = rest;
                }
            }
        }
    }

    /// How far an answer for a pixel is from that of `exact`, pixels.
    pub fn error_px(&mut self, view: &View, [x, y]: [u32; 2], claimed: f64) -> anyhow::Result<f64> {
        loop {
            let scene = self.scene()?;
            match measure(&scene.resident, &scene.prepared, view, x, y, claimed) {
                Ok(error) => return Ok(error.error_px()),
                Err(Missing(keys)) => {
                    drop(scene);
                    self.load(&keys)?;
                }
            }
        }
    }
}
