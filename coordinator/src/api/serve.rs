//! The API by HTTP.
//!
//! Connections are bounded as those of the farm are: so many may be silent, and the oldest
//! of them gives way; so many may be served. A head has to come within a few seconds, an
//! answer has to be taken; bodies have a time of their own (see [`super::router`]).

use super::access::{Access, guard};
use super::{Desk, live, page, router};
use crate::strangers::Strangers;
use axum::Router;
use axum::body::Body;
use axum::routing::get;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{Sleep, sleep};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt;

/// Connections that have not sent a request yet; of more, the oldest gives way.
const SILENT_MAX: usize = 128;
/// Connections that have.
const SERVED_MAX: usize = 512;
/// How long the head of a request may take, and a connection may idle between two.
const HEAD_LIMIT: Duration = Duration::from_secs(10);
/// How long a peer may take nothing of an answer.
const WRITE_PATIENCE: Duration = Duration::from_secs(30);
/// Memory for the head of a request, bytes: at least what hyper wants.
const HEAD_BYTES_MAX: usize = 16 << 10;
/// Pause after the system refused to accept a connection.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// How long answers that are under way may take when the coordinator stops.
const FAREWELL: Duration = Duration::from_secs(1);

/// Where the API is served by HTTP, and to whom.
pub struct Web {
    /// Where.
    pub listener: TcpListener,
    /// To whom.
    pub access: Access,
}

/// Serves the API and the page until `stop` is cancelled.
pub(crate) async fn serve(web: Web, desk: Arc<Desk>, stop: CancellationToken) {
    let events = Router::new().route("/api/v1/events", get(live::events)).with_state(desk.clone());
    let routes = router(desk).merge(events).merge(page::routes());
    let routes = guard(routes, web.access);
    let silent = Arc::new(Strangers::new(SILENT_MAX));
    let served = Arc::new(Semaphore::new(SERVED_MAX));
    let tasks = TaskTracker::new();
    loop {
        tokio::select! {
            () = stop.cancelled() => break,
            accepted = web.listener.accept() => match accepted {
                Ok((stream, _)) => {
                    let (routes, silent, served) = (routes.clone(), silent.clone(), served.clone());
                    tasks.spawn(connection(stream, routes, silent, served, stop.clone()));
                }
                Err(error) => {
                    tracing::warn!("cannot accept an HTTP connection: {error}");
                    // Out of file handles, say: at once it would only fail again.
                    sleep(ACCEPT_PAUSE).await;
                }
            },
        }
    }
    tasks.close();
    tasks.wait().await;
}

async fn connection(
    stream: TcpStream,
    routes: Router,
    silent: Arc<Strangers>,
    served: Arc<Semaphore>,
    stop: CancellationToken,
) {
    let _ = stream.set_nodelay(true);
    let spoke = CancellationToken::new();
    let heard = spoke.clone();
    let service = service_fn(move |request: hyper::Request<Incoming>| {
        heard.cancel();
        routes.clone().oneshot(request.map(Body::new))
    });
    let mut connection = std::pin::pin!(
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_LIMIT)
            .max_buf_size(HEAD_BYTES_MAX)
            .serve_connection(TokioIo::new(Patient::new(stream)), service)
    );
    // How it ends is the browser's business.
    {
        let place = silent.enter();
        tokio::select! {
            _ = connection.as_mut() => return,
            () = place.given_away() => return,
            () = stop.cancelled() => return,
            () = spoke.cancelled() => {}
        }
    }
    let Ok(_seat) = served.try_acquire() else { return };
    tokio::select! {
        _ = connection.as_mut() => return,
        () = stop.cancelled() => {}
    }
    connection.as_mut().graceful_shutdown();
    let _ = tokio::time::timeout(FAREWELL, connection).await;
}

/// A stream on which writing fails when the peer takes nothing for [`WRITE_PATIENCE`].
struct Patient {
    stream: TcpStream,
    /// When patience ends, while something waits to be taken.
    until: Option<Pin<Box<Sleep>>>,
}

impl Patient {
    fn new(stream: TcpStream) -> Self {
        Patient { stream, until: None }
    }

    fn watch<T>(
        &mut self,
        context: &mut Context<'_>,
        written: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.until = None;
            return written;
        }
        let until = self.until.get_or_insert_with(|| Box::pin(sleep(WRITE_PATIENCE)));
        until.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Patient {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Patient {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watch(context, written)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
