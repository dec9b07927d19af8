//! Terrain on its way from the client that owns it to the workers that need it.
//!
//! A blob (a tile, or a store's index) is known by its hash and passed on as it is,
//! never decoded. The broker asks the owner once however many workers want the blob, and
//! keeps recent ones within a memory limit so that the next worker need not wait. It is a
//! pure state machine: the driver feeds it what happened and carries out its orders.
//!
//! Departures from a plain LRU cache: a blob larger than the whole limit is passed on but
//! not kept, and a blob that somebody waits for is never asked for twice.

use bytes::Bytes;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::id::{BlobHash, WorkerId};

/// Most blobs that may be awaited at once, for all workers together: the tiles of a few
/// hundred cold workers.
const AWAITED_MAX: usize = 1 << 16;

/// A connection of a client, who owns terrain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(pub u64);

/// What the driver has to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Order {
    /// Send a blob to a worker.
    Deliver(WorkerId, BlobHash, Bytes),
    /// Tell a worker that nobody has the blob, and why.
    Refuse(WorkerId, BlobHash, String),
    /// Ask a client for a blob.
    Ask(ClientId, BlobHash),
}

/// Who waits for what, and what is at hand.
#[derive(Debug)]
pub struct Broker {
    kept: BTreeMap<BlobHash, Kept>,
    /// Hashes by last use, oldest first.
    by_age: BTreeMap<u64, BlobHash>,
    clock: u64,
    kept_bytes: usize,
    limit_bytes: usize,
    wanted: BTreeMap<BlobHash, Wanted>,
}

#[derive(Debug)]
struct Kept {
    bytes: Bytes,
    last_use: u64,
}

#[derive(Debug)]
struct Wanted {
    /// Who has been asked and has not answered yet.
    asked: ClientId,
    /// Who may be asked after that.
    others: Vec<ClientId>,
    workers: BTreeSet<WorkerId>,
}

impl Broker {
    /// Keeps at most this many bytes of blobs.
    pub fn new(limit_bytes: usize) -> Self {
        Broker {
            kept: BTreeMap::new(),
            by_age: BTreeMap::new(),
            clock: 0,
            kept_bytes: 0,
            limit_bytes,
            wanted: BTreeMap::new(),
        }
    }

    /// A worker wants a blob that one of these clients should have.
    pub fn wanted(
        &mut self,
        worker: WorkerId,
        hash: BlobHash,
        owners: &[ClientId],
    ) -> Option<Order> {
        if let Some(bytes) = self.touch(hash) {
            return Some(Order::Deliver(worker, hash, bytes));
        }
        if let Some(wanted) = self.wanted.get_mut(&hash) {
            wanted.workers.insert(worker);
            return None;
        }
        if self.wanted.len() >= AWAITED_MAX {
            return Some(Order::Refuse(worker, hash, "too many blobs are awaited".into()));
        }
        let Some((&first, others)) = owners.split_first() else {
            return Some(Order::Refuse(worker, hash, "no client has this terrain".into()));
        };
        let wanted =
            Wanted { asked: first, others: others.to_vec(), workers: BTreeSet::from([worker]) };
        self.wanted.insert(hash, wanted);
        Some(Order::Ask(first, hash))
    }

    /// A client sent a blob. The caller has verified that its hash is right. A blob that
    /// nobody waits for (any more) is dropped: a client cannot fill our memory unasked.
    pub fn arrived(&mut self, hash: BlobHash, bytes: Bytes) -> Vec<Order> {
        let Some(wanted) = self.wanted.remove(&hash) else { return Vec::new() };
        self.keep(hash, bytes.clone());
        let deliver = |worker| Order::Deliver(worker, hash, bytes.clone());
        wanted.workers.into_iter().map(deliver).collect()
    }

    /// A client does not have a blob that it was asked for.
    pub fn missing(&mut self, client: ClientId, hash: BlobHash, why: &str) -> Vec<Order> {
        let Some(wanted) = self.wanted.get_mut(&hash).filter(|wanted| wanted.asked == client)
        else {
            return Vec::new();
        };
        if let Some(next) = wanted.others.pop() {
            wanted.asked = next;
            return vec![Order::Ask(next, hash)];
        }
        let workers = self.wanted.remove(&hash).map(|wanted| wanted.workers).unwrap_or_default();
        workers.into_iter().map(|worker| Order::Refuse(worker, hash, why.to_owned())).collect()
    }

    /// A worker is gone: nobody delivers to it any more.
    pub fn worker_gone(&mut self, worker: WorkerId) {
        self.wanted.retain(|_, wanted| {
            wanted.workers.remove(&worker);
            !wanted.workers.is_empty()
        });
    }

    /// A client is gone: what it was asked for will not come.
    pub fn client_gone(&mut self, client: ClientId) -> Vec<Order> {
        for wanted in self.wanted.values_mut() {
            wanted.others.retain(|&other| other != client);
        }
        let lost: Vec<_> = self
            .wanted
            .iter()
            .filter(|(_, wanted)| wanted.asked == client)
            .map(|(hash, _)| *hash)
            .collect();
        let orders = lost.into_iter().flat_map(|hash| {
            self.missing(client, hash, "the client that owns the terrain went away")
        });
        orders.collect()
    }

    fn touch(&mut self, hash: BlobHash) -> Option<Bytes> {
        let kept = self.kept.get_mut(&hash)?;
        self.by_age.remove(&kept.last_use);
        self.clock += 1;
        kept.last_use = self.clock;
        self.by_age.insert(self.clock, hash);
        Some(kept.bytes.clone())
    }

    fn keep(&mut self, hash: BlobHash, bytes: Bytes) {
        if bytes.len() > self.limit_bytes || self.kept.contains_key(&hash) {
            return;
        }
        while self.kept_bytes + bytes.len() > self.limit_bytes {
            let Some((_, oldest)) = self.by_age.pop_first() else { break };
            if let Some(dropped) = self.kept.remove(&oldest) {
                self.kept_bytes -= dropped.bytes.len();
            }
        }
        self.clock += 1;
        self.kept_bytes += bytes.len();
        self.by_age.insert(self.clock, hash);
        self.kept.insert(hash, Kept { bytes, last_use: self.clock });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const OWNER: ClientId = ClientId(1);

    fn hash(n: u8) -> BlobHash {
        BlobHash([n; 32])
    }

    fn blob(length: usize) -> Bytes {
        Bytes::from(vec![7; length])
    }

    #[test]
    fn the_owner_is_asked_once_and_everybody_is_served() {
        let mut broker = Broker::new(1000);
        assert_eq!(broker.wanted(WorkerId(1), hash(1), &[OWNER]), Some(Order::Ask(OWNER, hash(1))));
        assert_eq!(broker.wanted(WorkerId(2), hash(1), &[OWNER]), None);
        let orders = broker.arrived(hash(1), blob(10));
        assert_eq!(orders.len(), 2);
        let third = broker.wanted(WorkerId(3), hash(1), &[OWNER]);
        assert_eq!(third, Some(Order::Deliver(WorkerId(3), hash(1), blob(10))));
    }

    #[test]
    fn the_least_recently_used_blob_makes_room() {
        let mut broker = Broker::new(25);
        for n in 1..=2 {
            broker.wanted(WorkerId(1), hash(n), &[OWNER]);
            broker.arrived(hash(n), blob(10));
        }
        broker.wanted(WorkerId(1), hash(1), &[OWNER]);
        broker.wanted(WorkerId(1), hash(3), &[OWNER]);
        broker.arrived(hash(3), blob(10));
        assert!(matches!(broker.wanted(WorkerId(1), hash(1), &[OWNER]), Some(Order::Deliver(..))));
        assert!(matches!(broker.wanted(WorkerId(1), hash(2), &[OWNER]), Some(Order::Ask(..))));
    }

    #[test]
    fn a_blob_nobody_asked_for_is_dropped() {
        let mut broker = Broker::new(1000);
        assert!(broker.arrived(hash(9), blob(10)).is_empty());
        assert_eq!(broker.kept_bytes, 0);
    }

    #[test]
    fn workers_are_told_when_the_owner_goes_away() {
        let mut broker = Broker::new(1000);
        broker.wanted(WorkerId(1), hash(1), &[OWNER]);
        broker.wanted(WorkerId(2), hash(1), &[OWNER]);
        broker.worker_gone(WorkerId(2));
        let orders = broker.client_gone(OWNER);
        assert!(matches!(&orders[..], [Order::Refuse(WorkerId(1), h, _)] if *h == hash(1)));
        assert!(matches!(broker.wanted(WorkerId(1), hash(1), &[OWNER]), Some(Order::Ask(..))));
    }

    #[test]
    fn the_next_owner_is_asked_when_the_first_does_not_have_it() {
        let other = ClientId(2);
        let mut broker = Broker::new(1000);
        broker.wanted(WorkerId(1), hash(1), &[OWNER, other]);
        assert_eq!(broker.missing(OWNER, hash(1), "no"), [Order::Ask(other, hash(1))]);
        assert!(broker.missing(OWNER, hash(1), "no").is_empty(), "it has been asked already");
        let orders = broker.missing(other, hash(1), "no");
        assert_eq!(orders, [Order::Refuse(WorkerId(1), hash(1), "no".into())]);
    }

    proptest! {
        #[test]
        fn memory_stays_within_the_limit(steps in prop::collection::vec((0u8..20, 0usize..40, any::<bool>()), 0..200)) {
            let mut broker = Broker::new(100);
            for (n, length, ask) in steps {
                if ask {
                    broker.wanted(WorkerId(1), hash(n), &[OWNER]);
                } else {
                    broker.arrived(hash(n), blob(length));
                }
                prop_assert!(broker.kept_bytes <= 100);
                prop_assert_eq!(broker.kept.len(), broker.by_age.len());
                let sum: usize = broker.kept.values().map(|kept| kept.bytes.len()).sum();
                prop_assert_eq!(sum, broker.kept_bytes);
            }
        }
    }
}
