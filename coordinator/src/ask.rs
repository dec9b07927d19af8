//! The side that asks the coordinator's API over the link of the farm: the same address
//! and the same token as workers and renders have.
//!
//! A coordinator hangs up on a desk that is silent for long, as one is that sends terrain over
//! other lines: a line that has rested is opened anew with the next question.

use crate::dial::{DialError, dial};
use bytes::Bytes;
use std::time::{Duration, Instant};
use terrafarm_wire::limits::{DESK_BODY_MAX, PATH_BYTES_MAX};
use terrafarm_wire::link::{Connection, LinkError, Trust};
use terrafarm_wire::message::{Message, Request, Role, Verb};
use tokio::net::TcpStream;

/// How long an answer may take: that of the longest submission, and some.
const ANSWER_LIMIT: Duration = Duration::from_secs(300);

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

impl Line {
    /// Connects over a link that `trust` allows.
    ///
    /// # Errors
    /// If there is no coordinator, or it does not let us in.
    pub async fn open(address: &str, trust: &Trust) -> Result<Self, AskError> {
        let used = Instant::now();
        let (connection, welcome) = dial(address, trust, "desk", Role::Desk).await?;
        let (address, trust) = (address.to_owned(), trust.clone());
        let silence = Duration::from_micros(welcome.silence_us);
        Ok(Line { address, trust, connection, silence, used, number: 0 })
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
        if self.used.elapsed() >= self.silence {
            *self = Line::open(&self.address, &self.trust).await?;
        }
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
    use tokio::net::TcpListener;
    use tokio_util::sync::CancellationToken;

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
