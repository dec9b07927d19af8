//! A farm on this PC: a coordinator inside this process, workers as child processes.

use crate::secret;
use anyhow::Context;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_coordinator::client::Coordinator;
use terrafarm_coordinator::{Config, CoordinatorError};
use terrafarm_wire::link::{FarmToken, Trust};
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
    /// Its coordinator, as a client on this PC sees it.
    pub coordinator: Coordinator,
    /// Cancelled when the last worker has ended for good: nobody is left to render.
    pub deserted: CancellationToken,
    stop_workers: CancellationToken,
    stop_coordinator: CancellationToken,
    workers: JoinSet<anyhow::Result<()>>,
    serving: JoinHandle<Result<(), CoordinatorError>>,
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

/// How a worker is started.
#[derive(Debug, Clone)]
pub struct Recruit {
    /// The program, and what comes before "worker": to start it elsewhere, for example.
    pub command: Vec<OsString>,
    /// The coordinator, as the worker sees it.
    pub coordinator: String,
    /// The farm token, if the coordinator is not on the worker's loopback.
    pub token: Option<FarmToken>,
    /// What to call it.
    pub name: String,
    /// Its threads.
    pub threads: u32,
}

impl LocalFarm {
    /// Starts the coordinator and the workers. Workers end by themselves when the
    /// coordinator goes away, however it does.
    pub async fn start(crew: Crew) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        let recruit = |number: u32, address: SocketAddr| Recruit {
            command: vec![program.clone().into_os_string()],
            coordinator: address.to_string(),
            token: None,
            name: format!("local-{number}"),
            threads: crew.threads,
        };
        Self::with(crew.workers, "127.0.0.1:0", Trust::Loopback, recruit).await
    }

    /// As [`LocalFarm::start`], with workers that are started some other way; they are
    /// numbered from 1 and told the port that is listened on.
    pub async fn with(
        workers: u32,
        listen: &str,
        trust: Trust,
        recruit: impl Fn(u32, SocketAddr) -> Recruit,
    ) -> anyhow::Result<Self> {
        let listener = TcpListener::bind(listen)
            .await
            .with_context(|| format!("cannot listen on {listen}; is networking disabled here?"))?;
        let heard = listener.local_addr().context("cannot read the address listened on")?;
        let address = SocketAddr::from(([127, 0, 0, 1], heard.port()));
        let (stop_workers, stop_coordinator) = (CancellationToken::new(), CancellationToken::new());
        let deserted = CancellationToken::new();
        // The last clone to be dropped is that of the last worker.
        let leaving = Arc::new(deserted.clone().drop_guard());
        let seen = Coordinator { trust: trust.clone(), ..Coordinator::local(address) };
        let config = Config { name: "local".into(), trust, ..Config::default() };
        let until = stop_coordinator.clone().cancelled_owned();
        let serving = tokio::spawn(terrafarm_coordinator::run(config, listener, until));
        let mut crew = JoinSet::new();
        for number in 1..=workers {
            let until = stop_workers.clone();
            let recruit = recruit(number, address);
            // The first start is checked here, so that a missing program is an error at
            // once and not a farm without workers.
            let child = recruit.start()?;
            let present = leaving.clone();
            crew.spawn(async move {
                let ended = keep_alive(child, recruit, until).await;
                drop(present);
                ended
            });
        }
        let (coordinator, workers) = (seen, crew);
        Ok(LocalFarm { coordinator, deserted, stop_workers, stop_coordinator, workers, serving })
    }

    /// Ends workers and coordinator, and waits for them.
    pub async fn stop(mut self) {
        // Workers first: one that loses its coordinator would complain.
        self.stop_workers.cancel();
        while self.workers.join_next().await.is_some() {}
        self.stop_coordinator.cancel();
        let _ = self.serving.await;
    }
}

impl Recruit {
    fn start(&self) -> anyhow::Result<Child> {
        let (program, before) = self.command.split_first().context("no program to start")?;
        let mut command = Command::new(program);
        command.args(before).arg("worker").args(["--coordinator", &self.coordinator]);
        match &self.token {
            Some(token) => _ = command.env(secret::VARIABLE, token.to_text()),
            None => _ = command.arg("--plain"),
        }
        command
            .args(["--name", &self.name, "--threads", &self.threads.to_string()])
            // The store is on this PC already: a second copy on disk would serve nobody.
            .args(["--cache-limit", "0"])
            .arg("--once")
            // Whoever started this process is not told about its children.
            .env_remove("NOTIFY_SOCKET")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| {
                format!("cannot start a worker process from {}", Path::new(program).display())
            })
    }
}

async fn keep_alive(
    mut child: Child,
    recruit: Recruit,
    stop: CancellationToken,
) -> anyhow::Result<()> {
    let worker = recruit.name.as_str();
    for _ in 0..=RESTARTS_PER_WORKER {
        tokio::select! {
            () = stop.cancelled() => {
                // Killing is safe at any instruction; asking first would only be slower.
                let _ = child.kill().await;
                return Ok(());
            }
            ended = child.wait() => {
                let how = ended.map_or_else(|error| error.to_string(), |status| status.to_string());
                tracing::warn!(worker, %how, "a local worker ended; starting it again");
            }
        }
        // A program that cannot start must not be started without a pause.
        tokio::time::sleep(RESTART_PAUSE).await;
        child = recruit.start()?;
    }
    tracing::error!(worker, "a local worker keeps ending; going on without it");
    Ok(())
}
