//! The terrain part of the [`Farm`]: who is sent which blob, by whom, and what lies ahead.

use super::{Farm, Peer};
use crate::blobs::{ClientId, Order};
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId, WorkerId};
use terrafarm_wire::limits::{ELSEWHERE_MAX, WANT_BLOBS_MAX, clip_reason};
use terrafarm_wire::link::is_this_pc;
use terrafarm_wire::message::{Ahead, Blob, Elsewhere, NoBlob, WantBlobs};

/// Cameras that a worker is told ahead, and after how many of them it is told anew.
const AHEAD_CAMERAS: usize = 32;
const AHEAD_REFRESH: u32 = AHEAD_CAMERAS as u32 / 2;
/// Frames from one of them to the next: at least, and at most. The more workers there are,
/// the less each renders of a frame, and the less it should look ahead.
const AHEAD_STRIDE: [u32; 2] = [8, 64];

impl Farm {
    pub(super) fn want_blobs(&mut self, worker: WorkerId, want: &WantBlobs) {
        let opened = self.workers.get(&worker).map(|state| &state.opened);
        let owners: BTreeSet<_> = opened
            .into_iter()
            .flatten()
            .filter_map(|shot| self.shots.get(*shot).map(|shot| shot.client))
            .collect();
        let owners: Vec<_> = owners.into_iter().collect();
        let mut orders = Vec::new();
        for &hash in &want.hashes {
            let behind = want.elsewhere && self.broker.owners_are_behind(hash);
            if behind && self.redirect_above_bytes < u64::MAX && self.redirect(worker, hash) {
                continue;
            }
            orders.extend(self.broker.wanted(worker, hash, want.elsewhere, &owners));
        }
        self.carry_out(orders);
    }

    /// Carries out the broker's orders; questions to one client become one message.
    pub(super) fn carry_out(&mut self, orders: Vec<Order>) {
        let mut asks: BTreeMap<ClientId, Vec<_>> = BTreeMap::new();
        for order in orders {
            match order {
                Order::Deliver { worker, hash, bytes, elsewhere } => {
                    let full = self.unsent_bytes >= self.redirect_above_bytes;
                    if elsewhere && full && self.redirect(worker, hash) {
                        continue;
                    }
                    self.unsent_bytes += bytes.len() as u64;
                    self.broker.given(worker, hash);
                    self.send(Peer::Worker(worker), Blob { hash, bytes });
                }
                Order::Refuse(worker, hash, why) => {
                    let why = clip_reason(&why);
                    self.send(Peer::Worker(worker), NoBlob { hash, why });
                }
                Order::Ask(client, hash) => asks.entry(client).or_default().push(hash),
            }
        }
        for (client, hashes) in asks {
            for hashes in hashes.chunks(WANT_BLOBS_MAX) {
                let hashes = hashes.to_vec();
                self.send(Peer::Client(client), WantBlobs { hashes, elsewhere: false });
            }
        }
    }

    /// Names other workers that have a blob, if there are any that this one can reach.
    fn redirect(&mut self, worker: WorkerId, hash: BlobHash) -> bool {
        let reaches = |shelf: &SocketAddr| {
            let own = self.workers.get(&worker).and_then(|state| state.greeting.address);
            !is_this_pc(shelf.ip()) || own.is_some_and(is_this_pc)
        };
        let holders = self.broker.holders(hash).iter().filter(|holder| **holder != worker);
        let mut shelves: Vec<_> =
            holders.filter_map(|holder| self.workers.get(holder)?.shelf).filter(reaches).collect();
        if shelves.is_empty() {
            return false;
        }
        // Not all to the same one: each begins at another place of the list.
        let begin = worker.0 as usize % shelves.len();
        shelves.rotate_left(begin);
        shelves.truncate(ELSEWHERE_MAX);
        self.broker.given(worker, hash);
        self.send(Peer::Worker(worker), Elsewhere { hash, workers: shelves });
        true
    }

    /// Tells a worker that has come to a frame where the camera will be, now and then.
    pub(super) fn tell_ahead(&mut self, worker: WorkerId, shot: ShotId, frame: FrameIndex) {
        let [least, most] = AHEAD_STRIDE;
        let stride = (self.workers.len() as u32 / 2).clamp(least, most);
        let (Some(state), Some(told)) = (self.workers.get_mut(&worker), self.shots.get(shot))
        else {
            return;
        };
        if state.ahead.get(&shot).is_some_and(|&due| frame < due) {
            return;
        }
        state.ahead.insert(shot, frame.saturating_add(stride * AHEAD_REFRESH));
        let first = frame.saturating_add(stride);
        let frames = told.cameras.iter().skip(first as usize).step_by(stride as usize);
        let cameras: Vec<_> = frames.take(AHEAD_CAMERAS).copied().collect();
        if !cameras.is_empty() {
            self.send(Peer::Worker(worker), Ahead { shot, first, stride, cameras });
        }
    }

    /// A worker gives its blobs to others.
    pub(super) fn shares(&mut self, worker: WorkerId, port: u16) {
        if let Some(state) = self.workers.get_mut(&worker) {
            state.shelf = state.greeting.address.map(|address| SocketAddr::new(address, port));
        }
    }
}
