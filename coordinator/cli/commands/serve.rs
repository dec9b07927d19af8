//! `terrafarm coordinator` and `terrafarm worker`: the two services.

use crate::{Outcome, args, notify};
use anyhow::{Context, bail};
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};
use terrafarm_coordinator::Config;
use terrafarm_worker::{Reconnect, WorkerConfig};
use tokio::net::TcpListener;

const MIB: u64 = 1 << 20;

/// Serves a farm until Ctrl-C or SIGTERM.
pub fn coordinator(args: &args::Coordinator) -> anyhow::Result<Outcome> {
    let address = args.listen;
    if !address.ip().is_loopback() && !args.plain {
        bail!(
            "{address} can be reached from other PCs, and links are not encrypted or \
             authenticated yet; on a network you trust, say --plain as well"
        );
    }
    runtime()?.block_on(async {
        let listener = TcpListener::bind(address)
            .await
            .with_context(|| format!("cannot listen on {address}; is another coordinator running there?"))?;
        let address = listener.local_addr().context("cannot read the address listened on")?;
        // "Any address" is no address to connect to: this PC's name is.
        let reach = if address.ip().is_unspecified() {
            format!("{}:{}", pc_name(), address.port())
        } else {
            address.to_string()
        };
        println!("coordinator on {address}");
        println!("start workers with:  terrafarm worker --coordinator {reach}");
        println!("render with:         terrafarm render SCENE --flight FLIGHT -o OUT --coordinator {reach}");
        let config = Config {
            blob_memory_bytes: (args.blob_memory * MIB) as usize,
            ..Config::default()
        };
        let stop = stop_signal();
        notify::ready(&format!("listening on {address}"));
        terrafarm_coordinator::run(config, listener, told(stop)).await?;
        Ok(Outcome::Done)
    })
}

/// Works until Ctrl-C or SIGTERM, or with `--once` until the coordinator goes away.
pub fn worker(args: args::Worker) -> anyhow::Result<Outcome> {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    let config = WorkerConfig {
        coordinator: args.coordinator,
        name: args.name.unwrap_or_else(pc_name),
        threads: args.threads.unwrap_or(cores) as usize,
        cache_dir: (args.cache_limit > 0).then(|| args.cache_dir.unwrap_or_else(default_cache_dir)),
        cache_limit_bytes: args.cache_limit * MIB,
        memory_limit_bytes: args.memory_limit * MIB,
        reconnect: if args.once { Reconnect::NEVER } else { Reconnect::default() },
        seed: process_seed(),
    };
    runtime()?.block_on(async {
        let stop = stop_signal();
        // A coordinator that is not there yet is waited for, so the service is up already.
        notify::ready(&format!("working for {}", config.coordinator));
        terrafarm_worker::run(config, told(stop)).await?;
        Ok(Outcome::Done)
    })
}

/// The async runtime of a service: its threads move bytes, they never render.
pub(super) fn runtime() -> anyhow::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("cannot start the async runtime")
}

/// Passes a signal to stop on, and says so to the service manager.
async fn told(stop: impl Future<Output = ()>) {
    stop.await;
    notify::stopping();
}

/// Ends on Ctrl-C, and on SIGTERM where there is such a thing. SIGTERM is caught from the
/// call on, not from the first poll: a process that is init in a container would lose an
/// early one. Must be called within the runtime.
pub fn stop_signal() -> impl Future<Output = ()> {
    #[cfg(unix)]
    let terminate = {
        use tokio::signal::unix::{SignalKind, signal};
        signal(SignalKind::terminate())
    };
    async move {
        #[cfg(unix)]
        if let Ok(mut terminate) = terminate {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = tokio::signal::ctrl_c() => {}
            }
            return;
        }
        let _ = tokio::signal::ctrl_c().await;
    }
}

/// Different for every process that is started: the worker's incarnation.
fn process_seed() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    (since.as_nanos() as u64).rotate_left(24) ^ u64::from(std::process::id())
}

fn default_cache_dir() -> PathBuf {
    dirs::cache_dir().unwrap_or_else(std::env::temp_dir).join("terrafarm")
}

fn pc_name() -> String {
    let from_environment =
        ["HOSTNAME", "COMPUTERNAME"].iter().find_map(|name| std::env::var(name).ok());
    from_environment
        .or_else(|| {
            std::fs::read_to_string("/etc/hostname").ok().map(|name| name.trim().to_owned())
        })
        .filter(|name| !name.is_empty())
        .unwrap_or_else(|| "worker".into())
}
