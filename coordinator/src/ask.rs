//! The side that asks the coordinator's API over the link of the farm: the same address
//! and the same token as workers and renders have.
//!
//! A coordinator hangs up on a desk that is silent for long: a line that has rested, or was
//! lost, is opened anew with the next question. One that serves as many as it can turns desks
//! away for the moment; [`Turn`] says how long to try again. What changes something twice
//! when it is asked twice must not be asked by [`Line::ask_again`]: a shot has a key for that.

use crate::dial::{DialError, dial};
use bytes::Bytes;
use std::hash::{BuildHasher, RandomState};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use terrafarm_wire::limits::{DESK_BODY_MAX, PATH_BYTES_MAX};
use terrafarm_wire::link::{Connection, HandshakeError, LinkError, Trust};
use terrafarm_wire::message::{Message, Request, Role, Verb};
use tokio::net::TcpStream;

/// How long an answer may take: that of the longest submission, and some.
const ANSWER_LIMIT: Duration = Duration::from_secs(300);
/// The first pause before something is tried again; each is twice as long as the one before.
const PAUSE_FIRST: Duration = Duration::from_millis(250);
/// The longest pause.
const PAUSE_MAX: Duration = Duration::from_secs(5);
/// How often at most a person is told of waiting.
const TELL_EVERY: Duration = Duration::from_secs(60);

/// A line to a coordinator's desk.
#[derive(Debug)]
pub struct Line {
    address: String,
    trust: Trust,
    connection: Connection<TcpStream>,
    /// How long it may rest: the coordinator is patient for longer.
    silence: Duration,
    /// When it was used last.
    used: Instant,
    number: u32,
    /// Whether a question went wrong: nobody knows what would come next.
    is_broken: bool,
}

/// How long to try again where the coordinator has no time for now, and who is told.
pub struct Turn {
    limit: Duration,
    tell: Box<dyn Fn(&str) + Send + Sync>,
    told: Mutex<Option<Instant>>,
}

/// One wait for something.
struct Wait<'a> {
    turn: &'a Turn,
    since: Instant,
    pause: Duration,
}

impl Turn {
    /// Tries again for so long; `tell` gets a sentence for people when that begins, and now
    /// and then while it lasts.
    pub fn new(limit: Duration, tell: impl Fn(&str) + Send + Sync + 'static) -> Self {
        Turn { limit, tell: Box::new(tell), told: Mutex::new(None) }
    }

    fn begin(&self) -> Wait<'_> {
        Wait { turn: self, since: Instant::now(), pause: PAUSE_FIRST }
    }
}

impl Wait<'_> {
    /// Waits for a while after a failure; gives it back when the time is over.
    async fn after(&mut self, why: AskError) -> Result<(), AskError> {
        let left = self.turn.limit.saturating_sub(self.since.elapsed());
        if left.is_zero() {
            return Err(why);
        }
        {
            let mut told = self.turn.told.lock().unwrap_or_else(PoisonError::into_inner);
            if told.is_none_or(|last| last.elapsed() >= TELL_EVERY) {
                *told = Some(Instant::now());
                (self.turn.tell)(&format!("{why}; waiting, at most {} s more", left.as_secs()));
            }
        }
        // A random share of the pause, so that those who were turned away together do not come
        // back together.
        let share = RandomState::new().hash_one(0u8) as f64 / u64::MAX as f64;
        let pause = self.pause / 2 + (self.pause / 2).mul_f64(share);
        // Only the coordinator knows when it has time again, and it does not call.
        tokio::time::sleep(pause.min(left)).await;
        self.pause = (2 * self.pause).min(PAUSE_MAX);
        Ok(())
    }
}

/// What the API answered; its status is 200 or 206.
#[derive(Debug)]
pub struct Answer {
    /// How long the whole content is, bytes; `body` is all of it unless a range was asked.
    pub total: u64,
    /// JSON, or a file.
    pub body: Bytes,
}

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// There is no coordinator, or it does not let us in.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The connection was lost.
    #[error("coordinator {address} was lost: {source}; what it had acknowledged stays")]
    Lost {
        /// Where.
        address: String,
        /// What happened.
        source: LinkError,
    },
    /// It does not answer.
    #[error("coordinator {0} has not answered for {limit} s", limit = ANSWER_LIMIT.as_secs())]
    Silent(String),
    /// It speaks, but not of what was asked.
    #[error("coordinator {0} answers with something else; is it of the same version?")]
    OutOfPlace(String),
    /// What is asked is too long.
    #[error("{what} has {bytes} bytes; at most {most} can be sent")]
    TooLong {
        /// Which part.
        what: &'static str,
        /// How long it is.
        bytes: usize,
        /// How long it may be.
        most: usize,
    },
    /// The coordinator says no.
    #[error("{text}")]
    Refused {
        /// As in HTTP.
        status: u16,
        /// Why, and what to do.
        text: String,
    },
}

impl AskError {
    /// Whether the same may go well later. Somebody who was never there is not waited for.
    fn may_pass(&self, was_there: bool) -> bool {
        match self {
            AskError::Dial(DialError::Connect { .. }) => was_there,
            AskError::Dial(DialError::Handshake { source, .. }) => match source {
                HandshakeError::Refused { refusal, .. } | HandshakeError::TurnedAway(refusal) => {
                    refusal.is_temporary()
                }
                // All connections are taken, of which a coordinator has no time to tell.
                HandshakeError::Hangup
                | HandshakeError::Link(LinkError::Io(_) | LinkError::Cut | LinkError::Closed) => {
                    true
                }
                HandshakeError::TimedOut(_) => was_there,
                _ => false,
            },
            AskError::Lost { source, .. } => {
                !matches!(source, LinkError::Wire(_) | LinkError::Channel(_))
            }
            AskError::Silent(_) => true,
            AskError::Refused { status, .. } => matches!(status, 408 | 503),
            AskError::OutOfPlace(_) | AskError::TooLong { .. } => false,
        }
    }

    /// Whether the coordinator is there, and has no place for another desk now.
    pub fn is_full(&self) -> bool {
        matches!(self, AskError::Dial(DialError::Handshake { .. })) && self.may_pass(false)
    }
}

impl Line {
    /// As [`Line::open`]; a coordinator that is there and has no place is asked again.
    ///
    /// # Errors
    /// As [`Line::open`], when the time is over.
    pub async fn open_in_turn(address: &str, trust: &Trust, turn: &Turn) -> Result<Self, AskError> {
        let mut wait = turn.begin();
        loop {
            match Line::open(address, trust).await {
                Err(why) if why.may_pass(false) => wait.after(why).await?,
                opened => return opened,
            }
        }
    }

    /// Connects over a link that `trust` allows.
    ///
    /// # Errors
    /// If there is no coordinator, or it does not let us in.
    pub async fn open(address: &str, trust: &Trust) -> Result<Self, AskError> {
        let used = Instant::now();
        let (connection, welcome) = dial(address, trust, "desk", Role::Desk).await?;
        let (address, trust) = (address.to_owned(), trust.clone());
        let silence = Duration::from_micros(welcome.silence_us);
        Ok(Line { address, trust, connection, silence, used, number: 0, is_broken: false })
    }

    /// As [`Line::ask`], again and again while that may help: lines that are lost, answers
    /// that do not come, a coordinator that starts anew or has no time. Only for what does
    /// no more when it is asked twice.
    ///
    /// # Errors
    /// As [`Line::ask`], when the time is over.
    pub async fn ask_again(
        &mut self,
        verb: Verb,
        path: &str,
        range: Option<(u64, u64)>,
        body: Bytes,
        turn: &Turn,
    ) -> Result<Answer, AskError> {
        let mut wait = turn.begin();
        loop {
            match self.ask(verb, path, range, body.clone()).await {
                Err(why) if why.may_pass(true) => wait.after(why).await?,
                answered => return answered,
            }
        }
    }

    /// Asks for something; `range` is the first byte of the content and how many.
    ///
    /// # Errors
    /// If the line breaks, or the coordinator refuses.
    pub async fn ask(
        &mut self,
        verb: Verb,
        path: &str,
        range: Option<(u64, u64)>,
        body: Bytes,
    ) -> Result<Answer, AskError> {
        let lengths =
            [("the address", path.len(), PATH_BYTES_MAX), ("the body", body.len(), DESK_BODY_MAX)];
        for (what, bytes, most) in lengths {
            if bytes > most {
                return Err(AskError::TooLong { what, bytes, most });
            }
        }
        if self.is_broken || self.used.elapsed() >= self.silence {
            *self = Line::open(&self.address, &self.trust).await?;
        }
        self.is_broken = true;
        // The coordinator's patience begins with the question, not with its answer.
        self.used = Instant::now();
        self.number = self.number.wrapping_add(1);
        let request = Request { number: self.number, verb, path: path.to_owned(), range, body };
        let exchange = async {
            self.connection.send(&request.into()).await?;
            self.connection.recv().await
        };
        let address = || self.address.clone();
        let answered = tokio::time::timeout(ANSWER_LIMIT, exchange).await;
        let response = match answered.map_err(|_| AskError::Silent(address()))? {
            Ok(Some(Message::Response(response))) if response.number == self.number => response,
            Ok(Some(_)) => return Err(AskError::OutOfPlace(address())),
            Ok(None) => {
                return Err(AskError::Lost { address: address(), source: LinkError::Closed });
            }
            Err(source) => return Err(AskError::Lost { address: address(), source }),
        };
        self.is_broken = false;
        match response.status {
            200 | 206 => Ok(Answer { total: response.total, body: response.body }),
            status => Err(AskError::Refused { status, text: reason(&response.body) }),
        }
    }
}

/// The words of a refusal.
fn reason(body: &[u8]) -> String {
    let json: Option<serde_json::Value> = serde_json::from_slice(body).ok();
    let said = json.as_ref().and_then(|json| json["error"].as_str());
    said.unwrap_or("the coordinator refused, and did not say why").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::{Config, run};
    use tokio::io::AsyncReadExt;
    use tokio::net::TcpListener;
    use tokio_util::sync::CancellationToken;

    /// A coordinator for so many desks.
    async fn coordinator(desks_max: usize) -> (String, CancellationToken) {
        let greeting_limit = Duration::from_millis(200);
        serve(Config { desks_max, greeting_limit, ..Config::default() }).await
    }

    async fn serve(config: Config) -> (String, CancellationToken) {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address").to_string();
        let stop = CancellationToken::new();
        tokio::spawn(run(config, listener, stop.clone().cancelled_owned()));
        (address, stop)
    }

    #[tokio::test]
    async fn a_desk_that_finds_no_place_says_so_once_and_waits_for_one() {
        let (address, stop) = coordinator(1).await;
        let first = Line::open(&address, &Trust::Loopback).await.expect("a place");
        let refused = Line::open(&address, &Trust::Loopback).await.expect_err("none is left");
        assert!(refused.is_full(), "{refused}");
        let (tell, mut told) = tokio::sync::mpsc::unbounded_channel();
        let turn = Turn::new(Duration::from_secs(60), move |why| {
            let _ = tell.send(why.to_owned());
        });
        let second = tokio::spawn(async move {
            let line = Line::open_in_turn(&address, &Trust::Loopback, &turn).await;
            line?.ask_again(Verb::Get, "/healthz", None, Bytes::new(), &turn).await
        });
        let why = told.recv().await.expect("it waits");
        assert!(why.contains("as there are places") && why.contains("waiting"), "{why}");
        drop(first);
        let answer = second.await.expect("no panic");
        assert!(answer.is_ok(), "{answer:?}");
        assert_eq!(told.recv().await, None, "once is enough");
        stop.cancel();
    }

    /// A desk of which nothing more comes after so many bytes, until it is told to go on.
    async fn halting(
        address: &str,
        bytes: u64,
        go_on: CancellationToken,
    ) -> Connection<tokio::io::DuplexStream> {
        use terrafarm_wire::link::greet;
        use terrafarm_wire::message::Hello;
        let (near, far) = tokio::io::duplex(1 << 16);
        let stream = TcpStream::connect(address).await.expect("a coordinator");
        tokio::spawn(async move {
            let (mut from_near, mut to_near) = tokio::io::split(far);
            let (mut from_coordinator, mut to_coordinator) = stream.into_split();
            let up = async {
                let mut some = (&mut from_near).take(bytes);
                tokio::io::copy(&mut some, &mut to_coordinator).await.expect("sent");
                go_on.cancelled().await;
                let _ = tokio::io::copy(&mut from_near, &mut to_coordinator).await;
            };
            tokio::join!(up, async {
                let _ = tokio::io::copy(&mut from_coordinator, &mut to_near).await;
            });
        });
        let hello = Hello::new("halting", Role::Desk);
        let greeted = greet(near, None, hello, Duration::from_secs(60)).await;
        greeted.expect("it is let in").0
    }

    #[tokio::test]
    async fn long_bodies_wait_for_memory_and_short_ones_do_not() {
        const LONG: usize = 5 << 20;
        let config = Config {
            bodies_bytes_max: LONG + 1,
            bodies_patience: Duration::from_secs(1),
            ..Config::default()
        };
        let (address, stop) = serve(config).await;
        let request = |number, length: usize| -> Message {
            let (verb, path) = (Verb::Put, format!("/api/v1/blobs/{}", "0".repeat(64)));
            Request { number, verb, path, range: None, body: vec![0; length].into() }.into()
        };
        let go_on = CancellationToken::new();
        let mut first = halting(&address, 3 << 20, go_on.clone()).await;
        let first = tokio::spawn(async move {
            first.send(&request(1, LONG)).await.expect("sent");
            first.recv().await.expect("answered").expect("answered")
        });
        let mut line = Line::open(&address, &Trust::Loopback).await.expect("a place");
        let path = format!("/api/v1/blobs/{}", "0".repeat(64));
        let ask = async |line: &mut Line, length: usize| {
            line.ask(Verb::Put, &path, None, vec![0; length].into()).await
        };
        // Until the first one has its share.
        let turned_away = loop {
            match ask(&mut line, LONG).await {
                Err(AskError::Refused { .. }) => tokio::task::yield_now().await,
                other => break other,
            }
        };
        assert!(matches!(turned_away, Err(AskError::Lost { .. })), "{turned_away:?}");
        // It is answered: there is no queue.
        let short = ask(&mut line, 1 << 20).await;
        assert!(matches!(short, Err(AskError::Refused { status: 501, .. })), "{short:?}");
        assert!(!first.is_finished());
        go_on.cancel();
        let Message::Response(answer) = first.await.expect("no panic") else { panic!("no answer") };
        assert_eq!(answer.status, 501);
        let turn = Turn::new(Duration::from_secs(60), |_| {});
        let long = line.ask_again(Verb::Put, &path, None, vec![0; LONG].into(), &turn).await;
        assert!(matches!(long, Err(AskError::Refused { status: 501, .. })), "{long:?}");
        stop.cancel();
    }

    #[tokio::test]
    async fn a_turn_that_does_not_come_ends_with_the_reason() {
        let (address, stop) = coordinator(0).await;
        let turn = Turn::new(Duration::from_millis(300), |_| {});
        let refused = Line::open_in_turn(&address, &Trust::Loopback, &turn).await;
        assert!(refused.is_err_and(|why| why.is_full()));
        stop.cancel();
    }

    #[tokio::test]
    async fn a_line_that_has_rested_until_the_coordinator_hung_up_still_asks() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address").to_string();
        let mut config = Config::default();
        (config.scheduler.heartbeat_us, config.scheduler.silence_us) = (10_000, 50_000);
        let stop = CancellationToken::new();
        let serving = tokio::spawn(run(config, listener, stop.clone().cancelled_owned()));
        let mut line = Line::open(&address, &Trust::Loopback).await.expect("a coordinator");
        // As one does that sends terrain over other lines meanwhile.
        let hung_up = line.connection.recv().await;
        assert!(matches!(hung_up, Ok(None) | Err(_)), "{hung_up:?}");
        let answer = line.ask(Verb::Get, "/healthz", None, Bytes::new()).await;
        assert!(answer.is_ok(), "{answer:?}");
        stop.cancel();
        serving.await.expect("no panic").expect("no error");
    }
}
