//! Looking for a coordinator where none was named: on this PC, at the address where the last
//! one was, and wherever the network says that there is one.
//!
//! What the network says is a hint that anyone can give. Every address is tried at once, so
//! that none is waited for that leads nowhere, each for a short time and so many and no more.
//! With a farm token, the coordinator that proves it is ours, whatever it is called; if
//! several prove it, the one with the lowest name is taken and people are told. A search
//! never gives up because of what it found.

use crate::WorkerConfig;
use crate::dial::{Caller, Connected, Line, hello};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_wire::link::HandshakeError;
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};

/// How long one search lasts that finds nothing.
const PATIENCE: Duration = Duration::from_secs(3);
/// How long connecting to one address and proving the token there may take, and the greeting.
const ATTEMPT_LIMIT: Duration = Duration::from_secs(3);
/// After the first coordinator that lets us in, how long others are waited for. A local
/// network answers within a few milliseconds.
const OTHERS: Duration = Duration::from_millis(100);
/// How often a search tries again where nobody let us in, and how long each address is
/// waited for at least when more are announced than can be tried at once: a coordinator
/// answers within milliseconds, so nobody keeps it out by naming many that do not.
const AGAIN: Duration = Duration::from_millis(250);
/// Most announced addresses that are tried at once.
const AT_ONCE_MAX: usize = 128;
/// Most that are tried in one search: a network full of false announcements shall not make
/// this worker knock at every door.
const ADDRESSES_MAX: usize = 1024;
/// Most reasons that one report names.
const REASONS_MAX: usize = 4;

/// A coordinator that somebody announces.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Announced {
    /// What it is called there.
    pub name: String,
    /// One of its addresses.
    pub address: SocketAddr,
}

/// The network that is asked, and the people who are told.
pub trait Search: fmt::Debug + Send + Sync {
    /// Where a coordinator of this PC would be, whom no network announces.
    fn here(&self) -> SocketAddr;

    /// Begins to ask and to listen, within a runtime; both end when the receiver is dropped.
    fn begin(&self) -> mpsc::Receiver<Announced>;

    /// Something that people want to know.
    fn tell(&self, news: &News);
}

/// What a search tells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum News {
    /// No coordinator lets this worker in so far; why not, where one was found.
    Waiting(Vec<String>),
    /// The coordinator that this worker works for.
    Found {
        /// Where it is, and what it is called there.
        place: String,
        /// Others that prove the same token.
        others: Vec<String>,
    },
}

/// A place where a coordinator may be, the better one first.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    Here(SocketAddr),
    Last(SocketAddr),
    Told(Announced),
}

impl Place {
    fn address(&self) -> SocketAddr {
        match self {
            Place::Here(address) | Place::Last(address) => *address,
            Place::Told(announced) => announced.address,
        }
    }

    /// What the network calls it.
    fn name(&self) -> Option<&str> {
        match self {
            Place::Here(_) | Place::Last(_) => None,
            Place::Told(announced) => Some(&announced.name),
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Here(address) | Place::Last(address) => write!(out, "{address}"),
            Place::Told(Announced { name, address }) => write!(out, "{address} ({name})"),
        }
    }
}

/// Searches, one after the other, and what is known from those before.
pub(crate) struct Seeker {
    search: Arc<dyn Search>,
    /// Where the last coordinator was.
    last: Option<SocketAddr>,
    /// What people were told last.
    told: Option<News>,
}

impl Seeker {
    pub fn new(search: Arc<dyn Search>) -> Self {
        Seeker { search, last: None, told: None }
    }

    /// One search; the error says in words what it came to.
    pub async fn connect(&mut self, config: &WorkerConfig) -> Result<Connected, String> {
        let mut heard = self.search.begin();
        let mut tries = Tries::new(Caller::of(config));
        let ends = Instant::now() + PATIENCE;
        let last_call = ends + ATTEMPT_LIMIT;
        let mut again = interval(AGAIN);
        again.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            // What was begun in time may end in time.
            let over = if tries.is_idle() { ends } else { last_call };
            let settled = tries.settled;
            tokio::select! {
                Some(announced) = heard.recv() => tries.begin(Place::Told(announced)),
                Some(()) = tries.next() => {}
                now = again.tick() => {
                    tries.fill();
                    if now < ends {
                        tries.begin(Place::Here(self.search.here()));
                        self.last.into_iter().for_each(|last| tries.begin(Place::Last(last)));
                    }
                }
                () = sleep_until(settled.unwrap_or(over)) => {
                    if settled.is_none() {
                        return Err(self.nobody(tries.refusals()));
                    }
                }
            }
            if tries.settled.is_some_and(|at| at <= Instant::now())
                && let Some(connected) = self.choose(&mut tries, config).await
            {
                return Ok(connected);
            }
        }
    }

    /// Greets the best of those who proved the token, or the next best.
    async fn choose(&mut self, tries: &mut Tries, config: &WorkerConfig) -> Option<Connected> {
        while let Some((place, line)) = tries.proved.pop_first() {
            let peer = line.peer();
            match line.greet(hello(config), ATTEMPT_LIMIT).await {
                Ok(connected) => {
                    self.last = Some(peer);
                    let others = tries.others_than(&place);
                    self.tell(News::Found { place: place.to_string(), others });
                    return Some(connected);
                }
                Err(why) => tries.refused(place, &why),
            }
        }
        tries.settled = None;
        None
    }

    /// Nobody was found: says so, once.
    fn nobody(&mut self, refusals: Vec<String>) -> String {
        let why = match refusals.is_empty() {
            true => "no coordinator on this PC, and none answers on this network".to_owned(),
            false => refusals.join("; "),
        };
        self.tell(News::Waiting(refusals));
        why
    }

    fn tell(&mut self, news: News) {
        if self.told.as_ref() != Some(&news) {
            self.search.tell(&news);
            self.told = Some(news);
        }
    }
}

/// What is being tried within one search.
struct Tries {
    caller: Caller,
    running: JoinSet<(Place, Result<Line, HandshakeError>)>,
    /// Announced places that are to be tried.
    queue: VecDeque<Place>,
    /// Those that are being tried, and since when, the oldest first.
    turns: VecDeque<(SocketAddr, AbortHandle, Instant)>,
    /// Addresses that are to be tried, are being tried, or lead to who proved the token.
    busy: BTreeSet<SocketAddr>,
    /// How many were announced.
    announced: usize,
    proved: BTreeMap<Place, Line>,
    /// Why others are not taken.
    refusals: BTreeMap<Place, String>,
    /// When one is chosen of those who have proved the token.
    settled: Option<Instant>,
}

impl Tries {
    fn new(caller: Caller) -> Self {
        Tries {
            caller,
            running: JoinSet::new(),
            queue: VecDeque::new(),
            turns: VecDeque::new(),
            busy: BTreeSet::new(),
            announced: 0,
            proved: BTreeMap::new(),
            refusals: BTreeMap::new(),
            settled: None,
        }
    }

    /// Whether nothing is under way.
    fn is_idle(&self) -> bool {
        self.running.is_empty() && self.queue.is_empty()
    }

    /// Tries a place, unless it is being tried. What is announced waits for its turn.
    fn begin(&mut self, place: Place) {
        let is_told = matches!(place, Place::Told(_));
        if is_told && self.announced >= ADDRESSES_MAX || !self.busy.insert(place.address()) {
            return;
        }
        if is_told {
            self.announced += 1;
            self.queue.push_back(place);
            self.fill();
        } else {
            self.open(place);
        }
    }

    /// Begins what waits for its turn, as far as there is room.
    fn fill(&mut self) {
        self.turns.retain(|(_, handle, _)| !handle.is_finished());
        while !self.queue.is_empty() {
            if self.turns.len() >= AT_ONCE_MAX {
                let has_had_it = |turn: &mut (_, _, Instant)| turn.2.elapsed() >= AGAIN;
                let Some((address, handle, _)) = self.turns.pop_front_if(has_had_it) else {
                    return;
                };
                handle.abort();
                self.busy.remove(&address);
            }
            if let Some(place) = self.queue.pop_front() {
                let address = place.address();
                let handle = self.open(place);
                self.turns.push_back((address, handle, Instant::now()));
            }
        }
    }

    fn open(&mut self, place: Place) -> AbortHandle {
        let (address, caller) = (place.address(), self.caller.clone());
        self.running.spawn(async move {
            let line = timeout(ATTEMPT_LIMIT, Line::open(address, &caller)).await;
            (place, line.unwrap_or(Err(HandshakeError::TimedOut(ATTEMPT_LIMIT))))
        })
    }

    /// Waits for one to end; `None` if none is under way.
    async fn next(&mut self) -> Option<()> {
        match self.running.join_next().await? {
            Ok((place, Ok(line))) => {
                // One of this PC, or the one from before, needs no comparison.
                let known = matches!(place, Place::Here(_) | Place::Last(_));
                let settled = Instant::now() + if known { Duration::ZERO } else { OTHERS };
                self.settled = Some(self.settled.map_or(settled, |before| before.min(settled)));
                self.proved.insert(place, line);
            }
            Ok((place, Err(why))) => self.refused(place, &why),
            // It has given way to others.
            Err(_) => {}
        }
        self.fill();
        Some(())
    }

    /// A place leads nowhere at the moment.
    fn refused(&mut self, place: Place, why: &HandshakeError) {
        self.busy.remove(&place.address());
        // That there is none on this PC is nothing to tell.
        let nobody_here =
            matches!(&place, Place::Here(_)) && matches!(why, HandshakeError::Link(_));
        if !nobody_here && (self.refusals.len() < REASONS_MAX || self.refusals.contains_key(&place))
        {
            self.refusals.insert(place, why.to_string());
        }
    }

    /// Other coordinators than the chosen one that proved the token. A coordinator has one
    /// name, and may have several addresses.
    fn others_than(&self, chosen: &Place) -> Vec<String> {
        let Some(name) = chosen.name() else { return Vec::new() };
        let named = self.proved.keys().filter_map(|other| Some((other.name()?, other)));
        let others: BTreeMap<_, _> = named.filter(|(other, _)| *other != name).collect();
        others.into_values().map(Place::to_string).collect()
    }

    /// Why those who were tried are not taken, in words.
    fn refusals(&self) -> Vec<String> {
        self.refusals.iter().map(|(place, why)| format!("coordinator {place}: {why}")).collect()
    }
}
