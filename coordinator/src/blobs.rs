//! Terrain on its way from the client that owns it to the workers that need it.
//!
//! A blob (a tile, or a store's index) is known by its hash and passed on as it is,
//! never decoded. The broker asks the owner once however many workers want the blob, and
//! keeps recent ones within a memory limit so that the next worker need not wait. It is a
//! pure state machine: the driver feeds it what happened and carries out its orders.
//!
//! It remembers who has been given what: others can be sent there ([`Broker::holders`])
//! where the links of the coordinator, or of the owner, are the limit.
//!
//! Departures from a plain LRU cache: a blob larger than the whole limit is passed on but
//! not kept, and a blob that somebody waits for is never asked for twice.

use bytes::Bytes;
use std::collections::BTreeMap;
use terrafarm_common::id::{BlobHash, WorkerId};
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::limits::WANT_BLOBS_MAX;

/// Most blobs that one worker may await. One that keeps the protocol awaits a few dozen, so
/// this is refused only to one that asks without end, and never because of others.
const AWAITED_MAX: usize = WANT_BLOBS_MAX;
/// Most blobs of which it is remembered who has them, and most workers remembered for each.
const HELD_MAX: usize = 1 << 16;
const HOLDERS_MAX: usize = 16;
/// So many blobs awaited of their owners mean that owners are the limit.
const OWNERS_BEHIND: usize = 128;

/// A connection of a client, who owns terrain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(pub u64);

/// What the driver has to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Order {
    /// Send a blob to a worker; `elsewhere` if it may be sent to another worker instead.
    Deliver { worker: WorkerId, hash: BlobHash, bytes: Bytes, elsewhere: bool },
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
    /// How many blobs each worker awaits, if it awaits any.
    awaiting: BTreeMap<WorkerId, usize>,
    /// Who has been given a blob, the first one first, and when it was given last.
    held: BTreeMap<BlobHash, (u64, Vec<WorkerId>)>,
    held_by_age: BTreeMap<u64, BlobHash>,
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
    /// Who waits, and whether another worker will do.
    workers: BTreeMap<WorkerId, bool>,
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
            awaiting: BTreeMap::new(),
            held: BTreeMap::new(),
            held_by_age: BTreeMap::new(),
        }
    }

    /// A worker wants a blob that one of these clients should have. `elsewhere` if it takes it
    /// from other workers, too; if not, it may have been given a damaged one, so that what
    /// is in memory is looked at again.
    pub fn wanted(
        &mut self,
        worker: WorkerId,
        hash: BlobHash,
        elsewhere: bool,
        owners: &[ClientId],
    ) -> Option<Order> {
        if !elsewhere {
            self.drop_if_damaged(hash);
        }
        if let Some(bytes) = self.touch(hash) {
            return Some(Order::Deliver { worker, hash, bytes, elsewhere });
        }
        let waits = self.wanted.get(&hash).is_some_and(|w| w.workers.contains_key(&worker));
        let awaits = self.awaiting.get(&worker).copied().unwrap_or(0);
        if !waits && awaits >= AWAITED_MAX {
            let why = format!("this worker awaits {awaits} blobs already");
            return Some(Order::Refuse(worker, hash, why));
        }
        let mut order = None;
        if let Some(wanted) = self.wanted.get_mut(&hash) {
            wanted.workers.insert(worker, elsewhere);
            // It may come for another shot, whose client has the blob when that one goes.
            for &owner in owners {
                if owner != wanted.asked && !wanted.others.contains(&owner) {
                    wanted.others.push(owner);
                }
            }
        } else {
            let Some((&first, others)) = owners.split_first() else {
                return Some(Order::Refuse(worker, hash, "no client has this terrain".into()));
            };
            let workers = BTreeMap::from([(worker, elsewhere)]);
            let wanted = Wanted { asked: first, others: others.to_vec(), workers };
            self.wanted.insert(hash, wanted);
            order = Some(Order::Ask(first, hash));
        }
        if !waits {
            self.awaiting.insert(worker, awaits + 1);
        }
        order
    }

    /// Takes out those who wait for a blob.
    fn waiting(&mut self, hash: BlobHash) -> BTreeMap<WorkerId, bool> {
        let workers = self.wanted.remove(&hash).map(|wanted| wanted.workers).unwrap_or_default();
        for worker in workers.keys() {
            if let Some(awaits) = self.awaiting.get_mut(worker) {
                *awaits -= 1;
                if *awaits == 0 {
                    self.awaiting.remove(worker);
                }
            }
        }
        workers
    }

    /// A client sent a blob. The caller has verified that its hash is right. A blob that
    /// nobody waits for (any more) is dropped: a client cannot fill our memory unasked.
    pub fn arrived(&mut self, hash: BlobHash, bytes: Bytes) -> Vec<Order> {
        if !self.wanted.contains_key(&hash) {
            return Vec::new();
        }
        self.keep(hash, bytes.clone());
        let deliver = |(worker, elsewhere)| {
            let bytes = bytes.clone();
            Order::Deliver { worker, hash, bytes, elsewhere }
        };
        self.waiting(hash).into_iter().map(deliver).collect()
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
        let workers = self.waiting(hash);
        workers.into_keys().map(|worker| Order::Refuse(worker, hash, why.to_owned())).collect()
    }

    /// A worker is gone: nobody delivers to it any more.
    pub fn worker_gone(&mut self, worker: WorkerId) {
        self.awaiting.remove(&worker);
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

    /// Whether a blob is neither here nor soon to come, because owners are behind.
    pub fn owners_are_behind(&self, hash: BlobHash) -> bool {
        self.wanted.len() >= OWNERS_BEHIND
            && !self.kept.contains_key(&hash)
            && !self.wanted.contains_key(&hash)
    }

    /// Workers that have been given a blob, the first one first. Some may be gone, or may have
    /// forgotten it.
    pub fn holders(&self, hash: BlobHash) -> &[WorkerId] {
        self.held.get(&hash).map_or(&[], |(_, workers)| workers)
    }

    /// A worker has been given a blob, or been told where to get it.
    pub fn given(&mut self, worker: WorkerId, hash: BlobHash) {
        self.clock += 1;
        let (last, workers) = self.held.entry(hash).or_default();
        self.held_by_age.remove(last);
        *last = self.clock;
        self.held_by_age.insert(self.clock, hash);
        workers.retain(|other| *other != worker);
        if workers.len() >= HOLDERS_MAX {
            workers.remove(0);
        }
        workers.push(worker);
        if self.held.len() > HELD_MAX
            && let Some((_, oldest)) = self.held_by_age.pop_first()
        {
            self.held.remove(&oldest);
        }
    }

    /// Memory fails, too: what it changed must not be given again.
    fn drop_if_damaged(&mut self, hash: BlobHash) {
        if self.kept.get(&hash).is_some_and(|kept| hash_of(&kept.bytes) != hash)
            && let Some(kept) = self.kept.remove(&hash)
        {
            tracing::warn!(%hash, "a terrain blob was damaged in memory and is asked for again");
            self.by_age.remove(&kept.last_use);
            self.kept_bytes -= kept.bytes.len();
        }
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
        assert_eq!(
            broker.wanted(WorkerId(1), hash(1), true, &[OWNER]),
            Some(Order::Ask(OWNER, hash(1)))
        );
        assert_eq!(broker.wanted(WorkerId(2), hash(1), true, &[OWNER]), None);
        let orders = broker.arrived(hash(1), blob(10));
        assert_eq!(orders.len(), 2);
        let third = broker.wanted(WorkerId(3), hash(1), true, &[OWNER]);
        let (worker, hash, bytes) = (WorkerId(3), hash(1), blob(10));
        assert_eq!(third, Some(Order::Deliver { worker, hash, bytes, elsewhere: true }));
    }

    #[test]
    fn the_least_recently_used_blob_makes_room() {
        let mut broker = Broker::new(25);
        for n in 1..=2 {
            broker.wanted(WorkerId(1), hash(n), true, &[OWNER]);
            broker.arrived(hash(n), blob(10));
        }
        broker.wanted(WorkerId(1), hash(1), true, &[OWNER]);
        broker.wanted(WorkerId(1), hash(3), true, &[OWNER]);
        broker.arrived(hash(3), blob(10));
        assert!(matches!(
            broker.wanted(WorkerId(1), hash(1), true, &[OWNER]),
            Some(Order::Deliver { .. })
        ));
        assert!(matches!(
            broker.wanted(WorkerId(1), hash(2), true, &[OWNER]),
            Some(Order::Ask(..))
        ));
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
        broker.wanted(WorkerId(1), hash(1), true, &[OWNER]);
        broker.wanted(WorkerId(2), hash(1), true, &[OWNER]);
        broker.worker_gone(WorkerId(2));
        let orders = broker.client_gone(OWNER);
        assert!(matches!(&orders[..], [Order::Refuse(WorkerId(1), h, _)] if *h == hash(1)));
        assert!(matches!(
            broker.wanted(WorkerId(1), hash(1), true, &[OWNER]),
            Some(Order::Ask(..))
        ));
    }

    #[test]
    fn the_next_owner_is_asked_when_the_first_does_not_have_it() {
        let other = ClientId(2);
        let mut broker = Broker::new(1000);
        broker.wanted(WorkerId(1), hash(1), true, &[OWNER, other]);
        assert_eq!(broker.missing(OWNER, hash(1), "no"), [Order::Ask(other, hash(1))]);
        assert!(broker.missing(OWNER, hash(1), "no").is_empty(), "it has been asked already");
        let orders = broker.missing(other, hash(1), "no");
        assert_eq!(orders, [Order::Refuse(WorkerId(1), hash(1), "no".into())]);
    }

    #[test]
    fn a_client_that_goes_does_not_take_a_blob_from_the_shots_of_others() {
        let other = ClientId(2);
        let mut broker = Broker::new(1000);
        broker.wanted(WorkerId(1), hash(1), true, &[OWNER]);
        for _ in 0..2 {
            assert_eq!(broker.wanted(WorkerId(2), hash(1), true, &[OWNER, other]), None);
        }
        assert_eq!(broker.client_gone(OWNER), [Order::Ask(other, hash(1))]);
        let orders = broker.missing(other, hash(1), "no");
        assert_eq!(orders.len(), 2, "each is asked once: {orders:?}");
    }

    #[test]
    fn what_was_damaged_in_memory_is_found_when_it_is_asked_for_again() {
        let mut broker = Broker::new(1000);
        let sound = blob(10);
        let hash = hash_of(&sound);
        for (kept, again) in [(blob(10), false), (Bytes::from_static(b"damaged"), true)] {
            broker.wanted(WorkerId(1), hash, true, &[OWNER]);
            broker.arrived(hash, kept);
            let order = broker.wanted(WorkerId(1), hash, false, &[OWNER]);
            assert_eq!(matches!(order, Some(Order::Ask(..))), again, "{order:?}");
            broker.kept.clear();
            broker.by_age.clear();
            broker.kept_bytes = 0;
        }
    }

    #[test]
    fn who_was_given_a_blob_is_remembered_the_first_one_first_and_not_without_end() {
        let mut broker = Broker::new(1000);
        for worker in [1, 2, 1, 3] {
            broker.given(WorkerId(worker), hash(1));
        }
        assert_eq!(broker.holders(hash(1)), [2, 1, 3].map(WorkerId));
        assert!(broker.holders(hash(2)).is_empty());
        let many = |n: u32| BlobHash(std::array::from_fn(|at| n.to_le_bytes()[at % 4]));
        for n in 0..HELD_MAX as u32 + 10 {
            broker.given(WorkerId(4), many(n + 10_000));
        }
        assert_eq!((broker.held.len(), broker.held_by_age.len()), (HELD_MAX, HELD_MAX));
        assert!(broker.holders(hash(1)).is_empty(), "the oldest goes");
        (0..100).for_each(|worker| broker.given(WorkerId(worker), hash(5)));
        assert_eq!(broker.holders(hash(5)).len(), HOLDERS_MAX);
    }

    #[test]
    fn a_worker_that_asks_without_end_is_refused_and_others_are_not() {
        let mut broker = Broker::new(1000);
        let many = |n: usize| BlobHash(std::array::from_fn(|at| n.to_le_bytes()[at % 8]));
        let mut want =
            |worker: u64, n: usize| broker.wanted(WorkerId(worker), many(n), true, &[OWNER]);
        let workers = 100;
        for n in 0..AWAITED_MAX * workers {
            let order = want((n / AWAITED_MAX) as u64, n);
            assert_eq!(order, Some(Order::Ask(OWNER, many(n))), "{n}");
        }
        assert!(matches!(want(0, 0x7f_0000), Some(Order::Refuse(WorkerId(0), ..))));
        assert_eq!(want(0, 5), None, "it waits for this one already");
        broker.arrived(many(5), blob(10));
        broker.missing(OWNER, many(6), "no");
        for n in [0x7f_0000, 0x7f_0001] {
            let order = broker.wanted(WorkerId(0), many(n), true, &[OWNER]);
            assert!(matches!(order, Some(Order::Ask(..))), "there is room again: {order:?}");
        }
        for worker in 0..workers as u64 {
            broker.worker_gone(WorkerId(worker));
        }
        assert!(broker.wanted.is_empty() && broker.awaiting.is_empty());
    }

    proptest! {
        #[test]
        fn memory_stays_within_the_limit(steps in prop::collection::vec((0u8..20, 0usize..40, any::<bool>()), 0..200)) {
            let mut broker = Broker::new(100);
            for (n, length, ask) in steps {
                if ask {
                    broker.wanted(WorkerId(1), hash(n), true, &[OWNER]);
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
