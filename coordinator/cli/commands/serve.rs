//! `terrafarm coordinator` and `terrafarm worker`: the two services.

use crate::secret::{self, Source};
use crate::{Outcome, args, files, identity, lan, notify};
use anyhow::{Context, bail};
use std::io::IsTerminal;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use terrafarm_coordinator::api::{Access, Web, WebKey};
use terrafarm_coordinator::queue::QueueConfig;
use terrafarm_coordinator::{Config, Coordinator};
use terrafarm_wire::link::{Trust, is_this_pc};
use terrafarm_worker::office::Rules;
use terrafarm_worker::{Reconnect, ShareTiles, Whereabouts, WorkerConfig};
use tokio::net::TcpListener;

const MIB: u64 = 1 << 20;
/// Open files that are enough for a thousand workers, and the queue.
const FILES_ENOUGH: u64 = 1200;
/// How long threads that wait for a disk may take when the coordinator stops.
const FAREWELL: Duration = Duration::from_secs(2);
/// Where the page is, unless told otherwise.
const HTTP: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7071);

/// Serves a farm until Ctrl-C or SIGTERM.
pub fn coordinator(args: &args::serve::Coordinator) -> anyhow::Result<Outcome> {
    let address = args.listen;
    let web = args.web.http.unwrap_or(HTTP);
    let reachable = !is_this_pc(address.ip()) || !(args.web.no_http || is_this_pc(web.ip()));
    warn_of_few_files(files::raise_open_files());
    let (trust, source) = secret::to_serve(&args.security, reachable)?;
    let runtime = runtime()?;
    let served = runtime.block_on(async {
        let listener = TcpListener::bind(address).await.with_context(|| {
            format!("cannot listen on {address}; is another coordinator running there?")
        })?;
        let address = listener.local_addr().context("cannot read the address listened on")?;
        let web = listen_http(&args.web, &trust).await?;
        let page = web.as_ref().map(where_it_is).transpose()?;
        let config = Config {
            blob_memory_bytes: (args.blob_memory * MIB) as usize,
            redirect_above_bytes: args.share_above * MIB,
            trust: trust.clone(),
            queue: args.data.as_deref().map(QueueConfig::new),
            journal: args.journal.clone(),
            scheduler: terrafarm_sched::Config { audit: args.audit, ..Default::default() },
            ..Config::default()
        };
        // Nobody is told of a coordinator that cannot use its folder.
        let coordinator = Coordinator::open(config, listener, web).await?;
        announce(address, &trust, source.as_ref());
        if let Some(page) = page {
            print_line!("look at it:          {page}");
        }
        if let Some(path) = coordinator.journal() {
            print_line!("journal:             in {}", path.display());
        }
        let _announced = announce_on_lan(args, address);
        let stop = stop_signal();
        notify::ready(&format!("listening on {address}"));
        coordinator.serve(told(stop)).await;
        Ok(Outcome::Done)
    });
    // What a slow disk holds up is cut off there, as it may be anywhere.
    runtime.shutdown_timeout(FAREWELL);
    served
}

/// A worker takes a file handle; a farm of many should not learn that in the night.
fn warn_of_few_files(files: Option<u64>) {
    if let Some(files) = files.filter(|&files| files < FILES_ENOUGH) {
        eprintln!(
            "terrafarm: warning: this system lets the coordinator open {files} files, which is less \
             than as many workers; \"ulimit -n\" or LimitNOFILE= raises that"
        );
    }
}

/// Lets workers on the local network find this coordinator.
fn announce_on_lan(
    args: &args::serve::Coordinator,
    address: SocketAddr,
) -> Option<lan::Announcement> {
    if args.no_announce || is_this_pc(address.ip()) {
        return None;
    }
    match lan::Announcement::begin(address, &pc_name()) {
        Ok(announced) => Some(announced),
        Err(why) => {
            tracing::warn!("workers cannot find this coordinator by themselves: {why:#}");
            None
        }
    }
}

/// The socket of the page, and who may use it. A port that is taken is an error only if it
/// was asked for.
async fn listen_http(args: &args::queue::Web, trust: &Trust) -> anyhow::Result<Option<Web>> {
    if args.no_http {
        return Ok(None);
    }
    let address = args.http.unwrap_or(HTTP);
    let listener = match TcpListener::bind(address).await {
        Ok(listener) => listener,
        Err(error) if args.http.is_none() => {
            eprintln!(
                "terrafarm: warning: no page, since {address} cannot be listened on: {error}; \
                 --http names another address, --no-http goes without"
            );
            return Ok(None);
        }
        Err(error) => {
            return Err(error).with_context(|| format!("cannot serve the page on {address}"));
        }
    };
    let key = match trust {
        Trust::Token(token) if args.http_key || !is_this_pc(address.ip()) => {
            Some(WebKey::of(token))
        }
        Trust::Loopback | Trust::Network if args.http_key => bail!(
            "--http-key: there is no farm token to derive a key from; make one with \
             \"terrafarm token\", and do not say --plain"
        ),
        _ => None,
    };
    let names = args.http_names.iter().cloned().chain([pc_name()]).collect();
    Ok(Some(Web { listener, access: Access { key, names } }))
}

/// Where the page is, in words.
fn where_it_is(web: &Web) -> anyhow::Result<String> {
    let address = web.listener.local_addr().context("cannot read the address of the page")?;
    let host = match address.ip().is_unspecified() {
        true => format!("{}:{}", pc_name(), address.port()),
        false => address.to_string(),
    };
    let key = if web.access.key.is_some() { "  (key: terrafarm token --web)" } else { "" };
    Ok(format!("http://{host}/{key}"))
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
    print_line!("coordinator on {address}");
    print_line!("start workers with:  {before}terrafarm worker --coordinator {reach}{after}");
    print_line!(
        "render with:         {before}terrafarm render SCENE --flight FLIGHT -o OUT --coordinator {reach}{after}"
    );
    match source {
        Some(Source::File(path)) => print_line!("farm token:          in {}", path.display()),
        Some(Source::Variable) => print_line!("farm token:          from {}", secret::VARIABLE),
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
pub fn worker(args: args::serve::Worker) -> anyhow::Result<Outcome> {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    let cache_dir =
        (args.cache_limit > 0).then(|| args.cache_dir.unwrap_or_else(default_cache_dir));
    let config = WorkerConfig {
        trust: secret::to_connect(&args.security)?,
        coordinator: match &args.coordinator {
            Some(address) => Whereabouts::At(address.clone()),
            None => Whereabouts::Sought(Arc::new(lan::Lan)),
        },
        name: args.name.unwrap_or_else(pc_name),
        threads: args.threads.unwrap_or(cores) as usize,
        identity: cache_dir.as_deref().map_or(0, |folder| identity::of_this_pc(folder, &pc_name())),
        cache_dir,
        cache_limit_bytes: args.cache_limit * MIB,
        memory_limit_bytes: args.memory_limit * MIB,
        share: match args.share_port {
            _ if args.no_share => ShareTiles::Never,
            Some(port) => ShareTiles::At(port),
            None => ShareTiles::Beyond,
        },
        rules: Rules { hours: args.hours, polite: args.polite },
        bandwidth_bytes_per_s: args.bandwidth.map(|megabits| megabits * 1_000_000 / 8),
        reconnect: if args.once { Reconnect::NEVER } else { Reconnect::default() },
        seed: process_seed(),
    };
    let status = match &args.coordinator {
        Some(address) => format!("working for {address}"),
        None => "looking for a coordinator".to_owned(),
    };
    runtime()?.block_on(async {
        let stop = stop_signal();
        // A coordinator that is not there yet is waited for, so the service is up already.
        notify::ready(&status);
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
