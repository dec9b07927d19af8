//! The task of the queue.

use super::blobs::Blobs;
use super::{Command, QueueConfig, QueueError, ShotList};
use crate::driver::FarmLine;
use std::sync::Arc;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

/// Everything that the queue knows.
pub(super) struct Task {
    config: Arc<QueueConfig>,
    blobs: Arc<Blobs>,
    farm: FarmLine,
    inbox: mpsc::Receiver<Command>,
    list: watch::Sender<ShotList>,
}

impl Task {
    pub async fn open(
        config: Arc<QueueConfig>,
        blobs: Arc<Blobs>,
        farm: FarmLine,
        inbox: mpsc::Receiver<Command>,
    ) -> Result<(Task, watch::Receiver<ShotList>), QueueError> {
        let (list, view) = watch::channel(ShotList::default());
        Ok((Task { config, blobs, farm, inbox, list }, view))
    }

    pub async fn run(self, stop: CancellationToken) {
        stop.cancelled().await;
    }
}
