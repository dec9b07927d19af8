//! Messages that open, keep and close a connection.
//!
//! The layouts of [`Hello`], [`Welcome`] and [`Refused`] are frozen: later versions may
//! only append, and a reader ignores what is appended. So any two versions can greet.

use super::{Body, Unfit, fit_name, fit_reason, own_twin};
use crate::limits::{NEWEST_VERSION, OLDEST_VERSION, THREADS_MAX};
use serde::{Deserialize, Serialize};

/// The protocol versions that a program speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Versions {
    /// The oldest one.
    pub oldest: u16,
    /// The newest one.
    pub newest: u16,
}

impl Versions {
    /// Those of this program.
    pub const OURS: Versions = Versions { oldest: OLDEST_VERSION, newest: NEWEST_VERSION };

    /// The newest version that both speak.
    pub fn common(self, other: Versions) -> Option<u16> {
        let newest = self.newest.min(other.newest);
        (newest >= self.oldest.max(other.oldest)).then_some(newest)
    }
}

/// Who opens the connection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    /// Renders.
    Worker {
        /// Number of its render threads.
        threads: u32,
        /// A number drawn when the program started: the same one after a reconnect, so
        /// that the coordinator can tell a return from a newcomer of the same name.
        incarnation: u64,
        /// A number of the PC, the same one after a new start and whatever the worker is
        /// called; 0 where there is none that lasts. Nobody proves it.
        identity: u128,
    },
    /// Submits shots, supplies their terrain, takes their frames.
    Client,
    /// Asks the coordinator's API: see [`super::desk`].
    Desk,
    /// Another worker: asks for terrain blobs by hash, and for nothing else.
    Peer,
}

impl Role {
    /// What to call it in a message.
    pub fn name(&self) -> &'static str {
        match self {
            Role::Worker { .. } => "worker",
            Role::Client => "client",
            Role::Desk => "desk",
            Role::Peer => "peer",
        }
    }
}

/// The first message of a connection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The protocol versions it speaks.
    pub versions: Versions,
    /// Program and its version, for people.
    pub program: String,
    /// What to call it: a host name, usually.
    pub name: String,
    /// What it is here for.
    pub role: Role,
}

impl Body for Hello {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless(self.versions.oldest <= self.versions.newest, "the versions are inverted")?;
        if let Role::Worker { threads, .. } = self.role {
            let fits = (1..=THREADS_MAX).contains(&threads);
            Unfit::unless(fits, "the number of threads is out of range")?;
        }
        fit_name(&self.program)?;
        fit_name(&self.name)
    }
}

/// The connection is open; both sides speak `version` from now on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// The agreed protocol version.
    pub version: u16,
    /// Number of this connection: a worker's or a client's id.
    pub id: u64,
    /// What the coordinator calls itself.
    pub coordinator: String,
    /// How often the coordinator sends a [`Ping`], microseconds.
    pub heartbeat_us: u64,
    /// After how much silence either side takes the other for lost, microseconds.
    pub silence_us: u64,
}

impl Body for Welcome {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        let fits = 0 < self.heartbeat_us && self.heartbeat_us < self.silence_us;
        Unfit::unless(fits, "the heartbeat is not shorter than the silence")?;
        fit_name(&self.coordinator)
    }
}

/// Why a connection is refused. Numbers on the wire: append only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Refusal {
    /// No protocol version in common.
    Version,
    /// As many connections as there may be.
    Full,
    /// The coordinator is shutting down.
    Closing,
    /// The greeting was not one.
    Malformed,
    /// The farm token was not proved.
    Token,
    /// There is a token on the other side only.
    PlainOnly,
}

impl Refusal {
    /// Whether trying again later can help.
    pub fn is_temporary(self) -> bool {
        matches!(self, Refusal::Full | Refusal::Closing)
    }
}

/// The connection is not opened; the sender closes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// Why.
    pub refusal: Refusal,
    /// Why, and what to do, for people.
    pub text: String,
}

impl Body for Refused {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.text)
    }
}

/// Asks for a [`Pong`] of the same number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ping {
    /// Any number.
    pub number: u64,
}

impl Body for Ping {
    own_twin!();
}

/// Answers a [`Ping`] at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pong {
    /// The number of the [`Ping`].
    pub number: u64,
}

impl Body for Pong {
    own_twin!();
}

/// The sender ends the connection on purpose; nothing follows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Goodbye {
    /// Why, for people.
    pub reason: String,
}

impl Body for Goodbye {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_version_of_both_is_agreed() {
        let of = |oldest, newest| Versions { oldest, newest };
        assert_eq!(of(1, 3).common(of(2, 9)), Some(3));
        assert_eq!(of(2, 9).common(of(1, 3)), Some(3));
        assert_eq!(of(1, 1).common(of(1, 1)), Some(1));
        assert_eq!(of(1, 2).common(of(3, 4)), None);
        assert_eq!(of(3, 4).common(of(1, 2)), None);
    }
}
