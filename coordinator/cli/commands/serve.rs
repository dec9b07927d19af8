//! `terrafarm coordinator` and `terrafarm worker`: the two services.

use crate::secret::{self, Source};
use crate::{Outcome, args, notify};
use anyhow::Context;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};
use terrafarm_coordinator::Config;
use terrafarm_wire::link::{Trust, is_this_pc};
use terrafarm_worker::{Reconnect, ShareTiles, WorkerConfig};
use tokio::net::TcpListener;

const MIB: u64 = 1 << 20;

/// Serves a farm until Ctrl-C or SIGTERM.
pub fn coordinator(args: &args::Coordinator) -> anyhow::Result<Outcome> {
    let address = args.listen;
    let (trust, source) = secret::to_serve(&args.security, !is_this_pc(address.ip()))?;
    runtime()?.block_on(async {
        let listener = TcpListener::bind(address).await.with_context(|| {
            format!("cannot listen on {address}; is another coordinator running there?")
        })?;
        let address = listener.local_addr().context("cannot read the address listened on")?;
        announce(address, &trust, source.as_ref());
        let config = Config {
            blob_memory_bytes: (args.blob_memory * MIB) as usize,
            redirect_above_bytes: args.share_above * MIB,
            trust,
            ..Config::default()
        };
        let stop = stop_signal();
        notify::ready(&format!("listening on {address}"));
        terrafarm_coordinator::run(config, listener, told(stop)).await?;
        Ok(Outcome::Done)
    })
}

/// Says where the coordinator listens, and the exact lines that others need. The token
/// itself is shown to a person at a terminal only, never to a log.
fn announce(address: SocketAddr, trust: &Trust, source: Option<&Source>) {
    // "Any address" is no address to connect to: this PC's name is.
    let reach = if address.ip().is_unspecified() {
        format!("{}:{}", pc_name(), address.port())
    } else {
        address.to_string()
    };
    let (before, after) = match (trust, source) {
        (Trust::Network, _) => (String::new(), " --plain".to_owned()),
        (Trust::Token(token), _) if std::io::stdout().is_terminal() => {
            (with_variable(&token.to_text()), String::new())
        }
        (Trust::Token(_), Some(Source::File(path))) => {
            (String::new(), format!(" --token-file {}", quoted(&path.display().to_string())))
        }
        _ => (String::new(), String::new()),
    };
    println!("coordinator on {address}");
    println!("start workers with:  {before}terrafarm worker --coordinator {reach}{after}");
    println!(
        "render with:         {before}terrafarm render SCENE --flight FLIGHT -o OUT --coordinator {reach}{after}"
    );
    match source {
        Some(Source::File(path)) => println!("farm token:          in {}", path.display()),
        Some(Source::Variable) => println!("farm token:          from {}", secret::VARIABLE),
        None => {}
    }
}

/// The start of a line that gives a program the token, in the shell of this system.
fn with_variable(token: &str) -> String {
    if cfg!(windows) {
        format!("set \"{}={token}\" && ", secret::VARIABLE)
    } else {
        format!("{}={token} ", secret::VARIABLE)
    }
}

/// A path as a shell takes it for one word.
fn quoted(path: &str) -> String {
    let harmless = |symbol: char| symbol.is_alphanumeric() || "/\\:._-+~".contains(symbol);
    match path.chars().all(harmless) {
        true => path.to_owned(),
        false if cfg!(windows) => format!("\"{path}\""),
        false => format!("'{}'", path.replace('\'', "'\\''")),
    }
}

/// Works until Ctrl-C or SIGTERM, or with `--once` until the coordinator goes away.
pub fn worker(args: args::Worker) -> anyhow::Result<Outcome> {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    let config = WorkerConfig {
        trust: secret::to_connect(&args.security)?,
        coordinator: args.coordinator,
        name: args.name.unwrap_or_else(pc_name),
        threads: args.threads.unwrap_or(cores) as usize,
        cache_dir: (args.cache_limit > 0).then(|| args.cache_dir.unwrap_or_else(default_cache_dir)),
        cache_limit_bytes: args.cache_limit * MIB,
        memory_limit_bytes: args.memory_limit * MIB,
        share: match args.share_port {
            _ if args.no_share => ShareTiles::Never,
            Some(port) => ShareTiles::At(port),
            None => ShareTiles::Beyond,
        },
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
