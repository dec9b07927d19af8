//! What a shift does before its turn: looking ahead, and fetching and keeping what it saw.

use super::{Report, Shift, keep, read, reporting};
use crate::render::Caster;
use crate::session::{Event, Glance};
use terrafarm_common::id::BlobHash;
use terrafarm_raycast::View;
use terrafarm_terrain::codec::{self, CodecError};
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::message::{Blob, Elsewhere, OpenShot};

impl<C: Caster> Shift<'_, C> {
    /// Looks for a blob for later.
    pub(super) fn seek(&mut self, hash: BlobHash) -> Option<Event> {
        let room = self.site.terrain.has_room_ahead();
        let Some(cache) = self.site.cache.clone() else {
            return Some(if room { Event::Absent(hash) } else { Event::NoRoom(hash) });
        };
        self.spawn_early(
            move || match room {
                true => match read(&cache, &hash) {
                    Some(bytes) => early(hash, &bytes),
                    None => Report::Absent(hash),
                },
                false if cache.holds(&hash) => Report::Early(hash, None),
                false => Report::Absent(hash),
            },
            move |panic| Report::Spoiled(hash, panic),
        );
        None
    }

    /// Keeps a blob for later: in memory if there is room, and on disk.
    pub(super) fn stock(&mut self, blob: Blob) -> Option<Event> {
        let Blob { hash, bytes } = blob;
        let room = self.site.terrain.has_room_ahead();
        let (cache, failed) = (self.site.cache.clone(), self.site.cache_failed.clone());
        if !room && cache.is_none() {
            return Some(Event::NoRoom(hash));
        }
        self.spawn_early(
            move || {
                if hash_of(&bytes) != hash {
                    return Report::Damaged(hash);
                }
                keep(cache.as_deref(), &failed, &hash, &bytes);
                if room { early(hash, &bytes) } else { Report::Early(hash, None) }
            },
            move |panic| Report::Spoiled(hash, panic),
        );
        None
    }

    /// Asks other workers for a blob.
    pub(super) fn fetch(&self, elsewhere: Elsewhere) -> Option<Event> {
        let (others, reports) = (self.site.others.clone(), self.reports.clone());
        tokio::spawn(async move {
            let report = match others.fetch(&elsewhere).await {
                Some(blob) => Report::Fetched(blob),
                None => Report::Unfetched(elsewhere.hash),
            };
            // Nobody listens once the connection is lost.
            let _unheard = reports.send(report).await;
        });
        None
    }

    /// Finds out which tiles a view will need.
    pub(super) fn glance(&mut self, glance: Glance, shot: &OpenShot) -> Option<Event> {
        let Some(scene) = self.site.terrain.scene(shot.index) else {
            return Some(Event::Glanced(Vec::new()));
        };
        let Glance { shot: number, due, camera, region } = glance;
        let view = View { camera, shading: shot.shading.clone(), quality: shot.quality };
        let (caster, store, due) = (self.site.caster.clone(), shot.index, (number, due));
        self.spawn_early(
            move || Report::Glanced(store, due, caster.scout(&scene, &view, region)),
            move |_| Report::Glanced(store, due, Vec::new()),
        );
        None
    }

    /// The same beside the pool, for what is done before its turn: behind the pieces of a
    /// job it would wait for the end of the job. A few of these run at once at most.
    fn spawn_early(
        &self,
        run: impl FnOnce() -> Report<C> + Send + 'static,
        panicked: impl FnOnce(String) -> Report<C> + Send + 'static,
    ) {
        tokio::task::spawn_blocking(reporting(self.reports.clone(), run, panicked));
    }
}

/// A tile before its turn; anything else is left where it is.
fn early<C: Caster>(hash: BlobHash, bytes: &[u8]) -> Report<C> {
    match codec::decode(bytes) {
        Ok(tile) => Report::Early(hash, Some(tile)),
        Err(CodecError::NotATile) => Report::Early(hash, None),
        Err(error) => Report::Spoiled(hash, error.to_string()),
    }
}
