//! Workers that sleep instead of rendering: how much a coordinator can do, without a farm.
//!
//! Each sleeper is a connection like that of any worker: it greets, answers heartbeats,
//! and answers each grant after a while with made-up pixels of the right size. It casts no
//! ray, asks for no terrain and needs no thread, so thousands fit into one process. Every
//! sleeper keeps time: how long it had a job in hand, and how long it waited from each
//! result to the next job.

use crate::dial::CONNECT_LIMIT;
use bytes::Bytes;
use std::collections::VecDeque;
use std::time::{Duration, Instant};
use terrafarm_common::id::LeaseId;
use terrafarm_common::region::Region;
use terrafarm_wire::Message;
use terrafarm_wire::link::{Connection, HandshakeError, LinkError, greet};
use terrafarm_wire::message::{Done, Goodbye, Grant, Hello, Pong, RenderReport, Role, Timesheet};
use terrafarm_wire::pixels::Pixels;
use tokio::net::TcpStream;
use tokio_util::sync::CancellationToken;

/// Every byte of a made-up picture.
pub const GREY: u8 = 0x60;

/// One sleeping worker on an open connection.
pub struct Sleeper {
    connection: Connection<TcpStream>,
    /// How long a job takes.
    job: Duration,
}

/// What became of a sleeper.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Slept {
    /// Results sent.
    pub jobs: u64,
    /// From the first grant to the last result.
    pub span: Duration,
    /// How much of that it had a job in hand.
    pub busy: Duration,
    /// From each result to the beginning of the next job: nothing where one was in hand.
    pub waits: Vec<Duration>,
}

/// A job in hand.
struct Held {
    lease: LeaseId,
    region: Region,
}

/// The clock of a sleeper.
#[derive(Default)]
struct Hands {
    /// The first one runs, the others wait.
    held: VecDeque<Held>,
    /// When the first one began.
    began: Option<Instant>,
    /// When the first grant of all came, and when the last result was sent.
    first: Option<Instant>,
    last: Option<Instant>,
    slept: Slept,
}

impl Sleeper {
    /// Connects and greets as a worker of one thread.
    ///
    /// # Errors
    /// If the coordinator cannot be reached or refuses.
    pub async fn connect(
        coordinator: &str,
        name: &str,
        incarnation: u64,
        job: Duration,
    ) -> Result<Self, HandshakeError> {
        let connecting = tokio::time::timeout(CONNECT_LIMIT, TcpStream::connect(coordinator));
        let stream = connecting.await.map_err(|_| HandshakeError::TimedOut(CONNECT_LIMIT))?;
        let stream = stream.map_err(LinkError::Io)?;
        stream.set_nodelay(true).map_err(LinkError::Io)?;
        let hello = Hello::new(name, Role::Worker { threads: 1, incarnation, identity: 0 });
        let (connection, _welcome) = greet(stream, None, hello, CONNECT_LIMIT).await?;
        Ok(Sleeper { connection, job })
    }

    /// Answers jobs until told to stop, then leaves.
    ///
    /// # Errors
    /// If the connection is lost before.
    pub async fn work(self, stop: CancellationToken) -> Result<Slept, LinkError> {
        let (mut reader, mut writer) = self.connection.split();
        let mut hands = Hands::default();
        loop {
            let due = hands.began.map(|began| began + self.job);
            let received = tokio::select! {
                () = stop.cancelled() => break,
                () = until(due) => None,
                received = reader.recv() => Some(received?.ok_or(LinkError::Closed)?),
            };
            match received {
                None => {
                    if let Some(done) = hands.finish(Instant::now()) {
                        writer.send(&done?.into()).await?;
                    }
                }
                Some(Message::Grant(grant)) => hands.take(&grant, Instant::now()),
                Some(Message::Revoke(revoke)) => hands.drop_lease(revoke.lease, Instant::now()),
                Some(Message::Ping(ping)) => {
                    writer.send(&Pong { number: ping.number }.into()).await?;
                }
                Some(_) => {}
            }
        }
        writer.send(&Goodbye { reason: "the sleeper was told to stop".into() }.into()).await?;
        writer.close().await?;
        Ok(hands.slept)
    }
}

/// Sleeps until a job is due: not at all if that has passed, for ever if there is none.
async fn until(due: Option<Instant>) {
    match due {
        Some(due) if due <= Instant::now() => {}
        Some(due) => tokio::time::sleep_until(due.into()).await,
        None => std::future::pending().await,
    }
}

impl Hands {
    fn take(&mut self, grant: &Grant, now: Instant) {
        self.held.push_back(Held { lease: grant.lease, region: grant.region });
        if self.began.is_some() {
            return;
        }
        self.began = Some(now);
        self.first.get_or_insert(now);
        if let Some(last) = self.last {
            self.slept.waits.push(now.duration_since(last));
        }
    }

    /// The job that runs is over; the next one in hand begins.
    fn finish(&mut self, now: Instant) -> Option<Result<Done, LinkError>> {
        let held = self.held.pop_front()?;
        let spent = self.stop_clock(now);
        if !self.held.is_empty() {
            self.began = Some(now);
            self.slept.waits.push(Duration::ZERO);
        }
        self.slept.jobs += 1;
        self.last = Some(now);
        self.slept.span = self.first.map_or(Duration::ZERO, |first| now.duration_since(first));
        Some(answer(&held, spent))
    }

    fn drop_lease(&mut self, lease: LeaseId, now: Instant) {
        let runs = self.held.front().is_some_and(|held| held.lease == lease);
        self.held.retain(|held| held.lease != lease);
        if runs {
            self.stop_clock(now);
            self.began = (!self.held.is_empty()).then_some(now);
        }
    }

    /// Time since the job that runs began, which is counted.
    fn stop_clock(&mut self, now: Instant) -> Duration {
        let spent = self.began.take().map_or(Duration::ZERO, |began| now.duration_since(began));
        self.slept.busy += spent;
        spent
    }
}

/// Grey pixels of the right size.
fn answer(held: &Held, spent: Duration) -> Result<Done, LinkError> {
    let grey = Bytes::from(vec![GREY; held.region.area() as usize * 3]);
    let pixels = Pixels::raw(grey).map_err(|why| {
        LinkError::Io(std::io::Error::new(std::io::ErrorKind::InvalidData, why.to_string()))
    })?;
    // A job takes some time, whatever the clock says.
    let cost_us = (spent.as_micros() as u64).max(1);
    let report = RenderReport { cost_us, ..RenderReport::default() };
    let timesheet = Timesheet { idle_us: cost_us, ..Timesheet::default() };
    Ok(Done { lease: held.lease, report, timesheet, check: None, pixels })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use terrafarm_common::camera::Camera;
    use terrafarm_common::id::ShotId;

    fn grant(lease: u64) -> Grant {
        let size = (16, 16);
        let camera = Camera::from_angles(glam::DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, size);
        let region = Region { x: 0, y: 8, width: 8, height: 8 };
        Grant { lease: LeaseId(lease), shot: ShotId(1), frame: 0, region, camera }
    }

    #[test]
    fn a_queued_job_begins_at_once_and_an_empty_hand_waits() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut hands = Hands::default();
        hands.take(&grant(1), at(0));
        hands.take(&grant(2), at(1));
        let done = hands.finish(at(10)).unwrap().unwrap();
        assert_eq!((done.lease, done.report.cost_us), (LeaseId(1), 10_000));
        assert_eq!(done.pixels.packed_len(), 8 * 8 * 3);
        assert_eq!(hands.finish(at(20)).unwrap().unwrap().report.cost_us, 10_000);
        assert!(hands.finish(at(21)).is_none());
        hands.take(&grant(3), at(25));
        hands.finish(at(35)).unwrap().unwrap();
        assert_eq!(hands.slept.jobs, 3);
        assert_eq!(hands.slept.waits, [Duration::ZERO, Duration::from_millis(5)]);
        assert_eq!(hands.slept.busy, Duration::from_millis(30));
        assert_eq!(hands.slept.span, Duration::from_millis(35));
    }

    #[test]
    fn a_revoked_job_is_not_answered() {
        let start = Instant::now();
        let mut hands = Hands::default();
        hands.take(&grant(1), start);
        hands.take(&grant(2), start);
        hands.drop_lease(LeaseId(1), start);
        assert_eq!(hands.finish(start).unwrap().unwrap().lease, LeaseId(2));
        assert!(hands.finish(start).is_none());
    }
}
