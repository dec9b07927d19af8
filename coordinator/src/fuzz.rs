//! Ways in for the fuzz targets of `tests/fuzz`, and for nobody else: what they are to feed
//! is private, and stays so.

use crate::api::{Budget, Desk, Link};
use crate::driver::FarmLine;
use crate::queue;
use std::time::Duration;
use terrafarm_wire::message::{Request, Response};
use tokio_util::sync::CancellationToken;

/// The API of a coordinator whose farm has ended and that has no queue.
pub struct Api(Link);

impl Default for Api {
    fn default() -> Self {
        let (line, stop) = (FarmLine::to_nobody(), CancellationToken::new());
        let budget = Budget::new(1 << 20, Duration::ZERO);
        Api(Link::new(Desk::new("fuzz", line, None, Default::default(), budget, stop)))
    }
}

impl Api {
    /// Answers a request as it comes over the encrypted link.
    pub async fn answer(&self, request: Request) -> Response {
        self.0.answer(request, None).await.0
    }
}

/// Reads a shot of the queue from the values of its records, as a coordinator does that
/// starts; whether they can be read. `progress` is the row of that name.
pub fn is_shot_on_record(record: &[u8], progress: (u32, u32, u32), cameras: &[u8]) -> bool {
    queue::is_shot_on_record(record, progress, cameras)
}

/// Reads what became of a frame; whether that can be read.
pub fn is_frame_on_record(record: &[u8]) -> bool {
    queue::is_frame_on_record(record)
}
