//! A byte stream that takes no more of the network than it is allowed.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

/// What may be used at once after a pause, as time at the full rate: short enough that a
/// second's average holds, long enough that a sleep carries some packets.
const BURST: Duration = Duration::from_millis(20);

/// A stream with a limit in each direction.
///
/// Receiving is slowed down by reading late: the system's buffers fill, and the sender's
/// side of TCP does the rest.
#[derive(Debug)]
pub struct Paced<S> {
    stream: S,
    read: Pace,
    write: Pace,
}

impl<S> Paced<S> {
    /// So many bytes a second each way; as many as the stream takes, if `None`.
    pub fn new(stream: S, bytes_per_s: Option<u64>) -> Self {
        Paced { stream, read: Pace::new(bytes_per_s), write: Pace::new(bytes_per_s) }
    }
}

/// One direction: a bucket that fills at the rate and may be emptied by one transfer.
#[derive(Debug)]
struct Pace {
    /// Bytes per second; no limit if `None`.
    rate: Option<f64>,
    /// Bytes that may be moved now.
    bucket: f64,
    filled: Instant,
    pause: Option<Pin<Box<Sleep>>>,
}

impl Pace {
    fn new(bytes_per_s: Option<u64>) -> Self {
        let rate = bytes_per_s.map(|rate| rate.max(1) as f64);
        Pace { rate, bucket: 0.0, filled: Instant::now(), pause: None }
    }

    /// Bytes that may be moved now, at least one; waits until there are some.
    fn poll_room(&mut self, context: &mut Context<'_>) -> Poll<usize> {
        let Some(rate) = self.rate else { return Poll::Ready(usize::MAX) };
        loop {
            if let Some(pause) = &mut self.pause {
                ready!(pause.as_mut().poll(context));
                self.pause = None;
            }
            let now = Instant::now();
            let most = (rate * BURST.as_secs_f64()).max(1.0);
            let fresh = rate * now.duration_since(self.filled).as_secs_f64();
            self.bucket = (self.bucket + fresh).min(most);
            self.filled = now;
            if self.bucket >= 1.0 {
                return Poll::Ready(self.bucket as usize);
            }
            // Half a burst at once: fewer, larger transfers.
            let missing = (most / 2.0).max(1.0) - self.bucket;
            let until = now + Duration::from_secs_f64(missing / rate);
            self.pause = Some(Box::pin(sleep_until(until)));
        }
    }

    fn moved(&mut self, bytes: usize) {
        if self.rate.is_some() {
            self.bucket -= bytes as f64;
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Paced<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = &mut *self;
        if this.read.rate.is_none() || into.remaining() == 0 {
            return Pin::new(&mut this.stream).poll_read(context, into);
        }
        let room = ready!(this.read.poll_room(context)).min(into.remaining());
        let mut part = ReadBuf::new(into.initialize_unfilled_to(room));
        ready!(Pin::new(&mut this.stream).poll_read(context, &mut part))?;
        let count = part.filled().len();
        into.advance(count);
        this.read.moved(count);
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Paced<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let this = &mut *self;
        let room = ready!(this.write.poll_room(context)).min(bytes.len());
        let count = ready!(Pin::new(&mut this.stream).poll_write(context, &bytes[..room]))?;
        this.write.moved(count);
        Poll::Ready(Ok(count))
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    /// A runtime whose clock stands still but for sleeps.
    fn on_a_virtual_clock(test: impl Future<Output = ()>) {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        runtime.enable_time().start_paused(true).build().unwrap().block_on(test);
    }

    async fn transfer(read_rate: Option<u64>, write_rate: Option<u64>, bytes: usize) -> Duration {
        let (near, far) = duplex(1 << 16);
        let (mut near, mut far) = (Paced::new(near, write_rate), Paced::new(far, read_rate));
        let began = Instant::now();
        let sent: Vec<u8> = (0..bytes).map(|i| (i % 251) as u8).collect();
        let expected = sent.clone();
        let sending = tokio::spawn(async move {
            near.write_all(&sent).await.unwrap();
            near.shutdown().await.unwrap();
        });
        let mut received = Vec::new();
        far.read_to_end(&mut received).await.unwrap();
        sending.await.unwrap();
        assert!(received == expected, "{} of {bytes} bytes arrived", received.len());
        began.elapsed()
    }

    #[test]
    fn both_directions_keep_their_rate() {
        on_a_virtual_clock(async {
            for (read, write) in [(Some(1_000_000), None), (None, Some(1_000_000))] {
                let seconds = transfer(read, write, 2_000_000).await.as_secs_f64();
                assert!((1.9..2.1).contains(&seconds), "{read:?} {write:?}: {seconds}");
            }
        });
    }

    #[test]
    fn without_a_limit_nothing_waits() {
        on_a_virtual_clock(async {
            assert_eq!(transfer(None, None, 1 << 20).await, Duration::ZERO);
        });
    }

    #[test]
    fn the_smallest_rate_still_moves_bytes() {
        on_a_virtual_clock(async {
            let seconds = transfer(Some(1), None, 5).await.as_secs_f64();
            assert!((4.0..7.0).contains(&seconds), "{seconds}");
        });
    }

    #[test]
    fn a_pause_does_not_save_up_more_than_a_burst() {
        on_a_virtual_clock(async {
            let (near, mut far) = duplex(1 << 20);
            let mut near = Paced::new(near, Some(100_000));
            near.write_all(&[0; 1000]).await.unwrap();
            // The pause is what is tested; the clock is virtual.
            tokio::time::sleep(Duration::from_secs(60)).await;
            let began = Instant::now();
            near.write_all(&[0; 100_000]).await.unwrap();
            assert!(began.elapsed() > Duration::from_millis(900), "{:?}", began.elapsed());
            let mut received = vec![0; 101_000];
            far.read_exact(&mut received).await.unwrap();
        });
    }
}
