//! A farm on this PC: a coordinator inside this process, workers as child processes.

use anyhow::Context;
use std::net::SocketAddr;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_coordinator::{Config, CoordinatorError};
use tokio::net::TcpListener;
use tokio::process::{Child, Command};
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;

/// A worker that dies is started again at most so often; one that keeps dying has a
/// reason that starting it again does not cure.
const RESTARTS_PER_WORKER: u32 = 3;
/// Pause before a worker is started again.
const RESTART_PAUSE: Duration = Duration::from_millis(200);

/// Where the local farm listens, and the means to end it.
pub struct LocalFarm {
    /// Address of its coordinator.
    pub address: SocketAddr,
    /// Cancelled when the last worker has ended for good: nobody is left to render.
    pub deserted: CancellationToken,
    stop_workers: CancellationToken,
    stop_coordinator: CancellationToken,
    workers: JoinSet<anyhow::Result<()>>,
    coordinator: JoinHandle<Result<(), CoordinatorError>>,
}

/// How many workers of how many threads.
#[derive(Debug, Clone, Copy)]
pub struct Crew {
    /// Worker processes.
    pub workers: u32,
    /// Threads of each.
    pub threads: u32,
}

impl Crew {
    /// What the user asked for, else one worker a core, at most eight, with all cores
    /// shared out among them.
    pub fn fill(workers: Option<u32>, threads: Option<u32>) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
        let workers = workers.unwrap_or(cores.min(8));
        Crew { workers, threads: threads.unwrap_or((cores / workers).max(1)) }
    }
}

impl LocalFarm {
    /// Starts the coordinator and the workers. Workers end by themselves when the
    /// coordinator goes away, however it does.
    pub async fn start(crew: Crew) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")
            .await
            .context("cannot listen on the loopback address; is networking disabled here?")?;
        let address = listener.local_addr().context("cannot read the address listened on")?;
        let (stop_workers, stop_coordinator) = (CancellationToken::new(), CancellationToken::new());
        let deserted = CancellationToken::new();
        // The last clone to be dropped is that of the last worker.
        let leaving = Arc::new(deserted.clone().drop_guard());
        let config = Config { name: "local".into(), ..Config::default() };
        let until = stop_coordinator.clone().cancelled_owned();
        let coordinator = tokio::spawn(terrafarm_coordinator::run(config, listener, until));
        let mut workers = JoinSet::new();
        for number in 1..=crew.workers {
            let until = stop_workers.clone();
            // The first start is checked here, so that a missing program is an error at
            // once and not a farm without workers.
            let child = start_worker(address, number, crew.threads)?;
            let present = leaving.clone();
            workers.spawn(async move {
                let ended = keep_alive(child, address, number, crew.threads, until).await;
                drop(present);
                ended
            });
        }
        Ok(LocalFarm { address, deserted, stop_workers, stop_coordinator, workers, coordinator })
    }

    /// Ends workers and coordinator, and waits for them.
    pub async fn stop(mut self) {
        // Workers first: one that loses its coordinator would complain.
        self.stop_workers.cancel();
        while self.workers.join_next().await.is_some() {}
        self.stop_coordinator.cancel();
        let _ = self.coordinator.await;
    }
}

fn start_worker(address: SocketAddr, number: u32, threads: u32) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    Command::new(&program)
        .arg("worker")
        .args(["--coordinator", &address.to_string(), "--plain"])
        .args(["--name", &format!("local-{number}")])
        .args(["--threads", &threads.to_string()])
        // The store is on this PC already: a second copy on disk would serve nobody.
        .args(["--cache-limit", "0"])
        .arg("--once")
        // Whoever started this process is not told about its children.
        .env_remove("NOTIFY_SOCKET")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .kill_on_drop(true)
        .spawn()
        .with_context(|| format!("cannot start a worker process from {}", program.display()))
}

async fn keep_alive(
    mut child: Child,
    address: SocketAddr,
    number: u32,
    threads: u32,
    stop: CancellationToken,
) -> anyhow::Result<()> {
    for _ in 0..=RESTARTS_PER_WORKER {
        tokio::select! {
            () = stop.cancelled() => {
                // Killing is safe at any instruction; asking first would only be slower.
                let _ = child.kill().await;
                return Ok(());
            }
            ended = child.wait() => {
                let how = ended.map_or_else(|error| error.to_string(), |status| status.to_string());
                tracing::warn!(worker = number, %how, "a local worker ended; starting it again");
            }
        }
        tokio::time::sleep(RESTART_PAUSE).await;
        child = start_worker(address, number, threads)?;
    }
    tracing::error!(worker = number, "a local worker keeps ending; going on without it");
    Ok(())
}
