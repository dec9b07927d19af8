//! What `deploy/` starts: units, the ssh launcher, manifests.
//!
//! Outside programs judge where they are present; where one is not, a line says so. The
//! ssh launcher talks to a real coordinator and real workers through an ssh that stays on
//! this PC.

use crate::support::{Dir, Running, coordinator, coordinator_with_token, run, succeed, terrafarm};
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::Command;

const PROGRAM: &str = env!("CARGO_BIN_EXE_terrafarm");

fn deploy(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(file)
}

fn text(file: &str) -> String {
    fs::read_to_string(deploy(file)).unwrap()
}

/// Whether a program is here; says so if not.
fn available(tool: &str) -> bool {
    let there = Command::new(tool).arg("--version").output().is_ok_and(|out| out.status.success());
    if !there {
        println!("skipped: {tool} is not on PATH");
    }
    there
}

/// Unknown commands and flags are refused before help is shown.
fn is_understood(arguments: &[String]) {
    succeed(terrafarm().args(arguments).arg("--help"));
}

/// Starts a service with a socket to tell its state to; checks what it tells.
fn tells_its_state(mut service: Command, name: &str, socket: &UnixDatagram, status: &str) {
    let told = || {
        let mut buffer = [0; 256];
        let length = socket.recv(&mut buffer).unwrap();
        String::from_utf8(buffer[..length].to_vec()).unwrap()
    };
    socket.set_read_timeout(Some(crate::support::PATIENCE)).unwrap();
    let running = Running::start(service.env("NOTIFY_SOCKET", name));
    let ready = told();
    assert!(ready.starts_with(&format!("READY=1\nSTATUS={status}")), "{ready}");
    // At once: whoever says that it is ready has its signals caught.
    running.signal("TERM");
    assert!(told().starts_with("STOPPING=1\n"));
    let (code, lines) = running.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
}

#[test]
fn services_tell_a_service_manager_that_they_are_ready_and_that_they_stop() {
    let dir = Dir::new();
    let path = dir.path("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    let name = path.to_str().unwrap();
    let mut service = terrafarm();
    service.args(["coordinator", "--listen", "127.0.0.1:0"]);
    tells_its_state(service, name, &socket, "listening on 127.0.0.1:");
    // Nobody coordinates there: a worker is up nevertheless, and waits.
    let mut service = terrafarm();
    service.args(["worker", "--coordinator", "127.0.0.1:1", "--cache-limit", "0"]);
    tells_its_state(service, name, &socket, "working for 127.0.0.1:1");
}

#[cfg(target_os = "linux")]
#[test]
fn a_service_manager_may_listen_without_a_file() {
    use std::os::linux::net::SocketAddrExt;
    let name = format!("terrafarm-whole-{}", std::process::id());
    let address = std::os::unix::net::SocketAddr::from_abstract_name(&name).unwrap();
    let socket = UnixDatagram::bind_addr(&address).unwrap();
    let mut service = terrafarm();
    service.args(["coordinator", "--listen", "127.0.0.1:0"]);
    tells_its_state(service, &format!("@{name}"), &socket, "listening on 127.0.0.1:");
}

#[test]
fn a_service_manager_that_does_not_listen_is_warned_about_and_ends_nothing() {
    let mut service = terrafarm();
    service.args(["coordinator", "--listen", "127.0.0.1:0"]);
    let mut running = Running::start(service.env("NOTIFY_SOCKET", "/nowhere/at/all"));
    running.expect("cannot be told");
    running.signal("TERM");
    assert_eq!(running.finish().0, Some(0));
}

const UNITS: [&str; 2] = ["terrafarm-coordinator.service", "terrafarm-worker.service"];

#[test]
fn units_start_commands_that_are_understood() {
    for unit in UNITS {
        let unit = text(&format!("systemd/{unit}"));
        let start = unit.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let line = start
            .replace("${TERRAFARM_LISTEN}", "0.0.0.0:7070")
            .replace("$TERRAFARM_OPTIONS", "")
            .replace("%C", "/var/cache");
        let words: Vec<_> = line.split_whitespace().map(str::to_owned).collect();
        assert_eq!(words[0], "/usr/local/bin/terrafarm");
        is_understood(&words[1..]);
    }
    for file in ["systemd/worker.env", "systemd/coordinator.env"] {
        let options = text(file);
        let options = options.lines().find_map(|line| line.strip_prefix("#TERRAFARM_OPTIONS="));
        let service = file.trim_start_matches("systemd/").trim_end_matches(".env");
        let words = [service].into_iter().chain(options.unwrap().split_whitespace());
        is_understood(&words.map(str::to_owned).collect::<Vec<_>>());
    }
}

#[test]
fn systemd_has_nothing_to_say_about_the_units() {
    if !available("systemd-analyze") {
        return;
    }
    let dir = Dir::new();
    for unit in UNITS {
        // The program is not installed here, and its absence would be complained about.
        let content = text(&format!("systemd/{unit}")).replace("/usr/local/bin/terrafarm", PROGRAM);
        let path = dir.write(unit, &content);
        // Ends with 0 on keys that it does not know; what it says is what counts.
        let (_, said) = run(Command::new("systemd-analyze").arg("verify").arg(&path), 0);
        let ours: Vec<_> = said.lines().filter(|line| line.contains("terrafarm")).collect();
        assert!(ours.is_empty(), "{ours:#?}");
        let path = dir.write(unit, content.replace("ProtectHome=", "ProtectHouse="));
        let (_, said) = run(Command::new("systemd-analyze").arg("verify").arg(&path), 0);
        assert!(said.contains("ProtectHouse"), "a wrong key is not noticed: {said}");
    }
}

#[test]
fn kubernetes_manifests_hold_what_the_schema_knows_and_nothing_else() {
    if !available("kubernetes-validate") {
        return;
    }
    let dir = Dir::new();
    for file in ["coordinator.yaml", "worker.yaml"] {
        let content = text(&format!("kubernetes/{file}"));
        let mut validate = Command::new("kubernetes-validate");
        succeed(validate.arg("--strict").arg(deploy("kubernetes").join(file)));
        let wrong = dir.write(file, content.replace("replicas:", "replica:"));
        run(Command::new("kubernetes-validate").arg("--strict").arg(wrong), 1);
    }
}

#[test]
fn containers_start_commands_that_are_understood() {
    for file in ["kubernetes/coordinator.yaml", "kubernetes/worker.yaml"] {
        let manifest = text(file);
        let args = manifest.lines().find_map(|line| line.trim().strip_prefix("args: ")).unwrap();
        is_understood(&serde_json::from_str::<Vec<String>>(args).unwrap());
    }
    let container = text("container/Containerfile");
    let runs: Vec<_> = container.lines().filter(|line| line.contains("podman run")).collect();
    assert_eq!(runs.len(), 2);
    for line in runs {
        let (_, arguments) = line.split_once(" terrafarm ").unwrap();
        is_understood(&arguments.split_whitespace().map(str::to_owned).collect::<Vec<_>>());
    }
}

#[test]
fn a_container_is_built_from_every_file_of_the_repository_that_the_program_holds() {
    let container = text("container/Containerfile");
    let copied: Vec<_> = container
        .lines()
        .filter_map(|line| line.strip_prefix("COPY "))
        .filter(|line| !line.starts_with("--from"))
        .flat_map(|line| {
            line.split_whitespace().collect::<Vec<_>>().split_last().unwrap().1.to_vec()
        })
        .collect();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for path in &copied {
        assert!(root.join(path).exists(), "{path} is copied and does not exist");
    }
    // The compiler writes what each crate was made of, by its path in the repository.
    let crates = Path::new(PROGRAM).with_file_name("deps");
    let is_ours = |name: &str| name.starts_with("terrafarm") && name.ends_with(".d");
    let made_of: String = fs::read_dir(crates)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.file_name().and_then(OsStr::to_str).is_some_and(is_ours))
        .map(|path| fs::read_to_string(path).unwrap())
        .collect();
    let lines = made_of.lines().filter(|line| !line.starts_with('#'));
    let words = lines.flat_map(str::split_whitespace).map(|word| word.trim_end_matches(':'));
    // What older builds were made of may be gone.
    let real = root.canonicalize().unwrap();
    let ours: BTreeSet<PathBuf> = words
        .filter(|word| !word.starts_with('/'))
        .filter_map(|word| root.join(word).canonicalize().ok())
        .filter_map(|path| path.strip_prefix(&real).ok().map(Path::to_path_buf))
        .collect();
    assert!(ours.contains(Path::new("deploy/scenes/demo.toml")), "the scene of the demo is held");
    for path in ours {
        let is_copied = copied.iter().any(|folder| path.starts_with(folder));
        assert!(is_copied, "{} is not copied", path.display());
    }
}

/// An ssh and an scp that reach "PCs" which are folders; `broken` cannot be reached. Like a
/// real one, this ssh hands no variable of the farm on.
struct Office {
    dir: Dir,
}

impl Office {
    fn new() -> Self {
        let dir = Dir::new();
        fs::create_dir(dir.path("bin")).unwrap();
        let options = "while [ \"${1#-}\" != \"$1\" ]; do\n\
             case $1 in -o) shift 2 ;; *) shift ;; esac\ndone\n";
        let ssh = format!(
            "#!/bin/sh\n{options}host=$1\nshift\n\
             if [ \"$host\" = broken ]; then\n\
             echo 'ssh: connect to host broken port 22: No route to host' >&2\nexit 255\nfi\n\
             HOME={}/$host HOST_NAME=$host\nexport HOME HOST_NAME\nunset TERRAFARM_TOKEN\n\
             mkdir -p \"$HOME\"\ncd \"$HOME\"\nexec sh -c \"$*\"\n",
            dir.path("").display()
        );
        let scp = format!(
            "#!/bin/sh\n{options}exec cp \"$1\" \"{}/${{2%%:*}}/${{2#*:}}\"\n",
            dir.path("").display()
        );
        for (name, script) in
            [("ssh", ssh), ("scp", scp), ("uname", "#!/bin/sh\necho \"$HOST_NAME\"\n".to_owned())]
        {
            let path = dir.write(&format!("bin/{name}"), script);
            succeed(Command::new("chmod").arg("+x").arg(path));
        }
        Office { dir }
    }

    fn launch(&self, hosts: &Path, coordinator: &str) -> Command {
        let mut command = Command::new(deploy("ssh/launch"));
        let path = format!(
            "{}:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin",
            self.dir.path("bin").display()
        );
        command.arg(hosts).arg(coordinator).env("PATH", path);
        command
    }
}

impl Drop for Office {
    fn drop(&mut self) {
        // Workers outlive the test only where it failed.
        for host in ["pc-two", "anna@pc-three"] {
            let folder = self.dir.path(host).join(".terrafarm");
            for file in fs::read_dir(folder).into_iter().flatten().flatten() {
                if file.path().extension().is_some_and(|extension| extension == "pid") {
                    let pid = fs::read_to_string(file.path()).unwrap_or_default();
                    let _ = Command::new("kill").arg("-9").arg(pid.trim()).output();
                }
            }
        }
    }
}

#[test]
fn a_crew_is_started_shown_and_stopped_by_ssh_and_hosts_that_fail_are_named() {
    let office = Office::new();
    let (mut coordinator, address) = coordinator();
    let hosts = office.dir.write(
        "hosts",
        "# host threads\npc-two 1\n\nbroken\nanna@pc-three 2 # by the window, no newline",
    );
    let launch = || office.launch(&hosts, &address);
    let broken = "broken: failed: ssh: connect to host broken port 22: No route to host";

    let (said, complaint) = run(&mut launch(), 1);
    assert!(said.contains("pc-two: failed: no terrafarm on the PATH"), "{said}");
    assert!(complaint.contains("start failed on 3 of 3 hosts"), "{complaint}");

    let (said, complaint) = run(launch().args(["start", "--copy", PROGRAM]), 1);
    let lines: Vec<_> = said.lines().collect();
    assert!(lines[0].starts_with("pc-two: started, process "), "{said}");
    assert!(lines[0].ends_with(", connected"), "{said}");
    assert_eq!(lines[1], broken);
    assert!(lines[2].starts_with("anna@pc-three: started, process "), "{said}");
    assert_eq!(lines.len(), 3);
    assert!(complaint.contains("start failed on 1 of 3 hosts"), "{complaint}");
    let mut joined = [coordinator.expect("worker joined"), coordinator.expect("worker joined")];
    joined.sort_by_key(|line| line.contains("pc-two"));
    for (line, name) in joined.iter().zip(["anna@pc-three", "pc-two"]) {
        assert!(line.contains(name), "{line}");
    }

    let (said, _) = run(&mut launch(), 1);
    assert!(said.contains("pc-two: runs already, process "), "{said}");
    let (said, _) = run(launch().arg("status"), 1);
    assert!(said.contains("pc-two: running, process "), "{said}");
    assert!(said.contains(broken), "{said}");

    let (said, _) = run(launch().arg("stop"), 1);
    assert!(said.contains("pc-two: stopped\n"), "{said}");
    assert!(said.contains("anna@pc-three: stopped\n"), "{said}");
    coordinator.expect("worker left: said goodbye");
    coordinator.expect("worker left: said goodbye");
    let (said, _) = run(launch().arg("status"), 1);
    assert!(said.contains("pc-two: failed: not running"), "{said}");

    let reachable = office.dir.write("reachable", "pc-two\n");
    let said = succeed(office.launch(&reachable, &address).arg("stop"));
    assert_eq!(said, "pc-two: was not running\n");
}

#[test]
fn a_crew_brings_the_token_of_whoever_launches_it() {
    let office = Office::new();
    let (mut coordinator, address, token) = coordinator_with_token(&office.dir);
    let hosts = office.dir.write("hosts", "pc-two 1\n");
    let launch = || {
        let mut command = office.launch(&hosts, &address);
        command.env_remove("TERRAFARM_TOKEN");
        command
    };
    let (said, _) = run(launch().args(["start", "--copy", PROGRAM]), 1);
    assert!(said.starts_with("pc-two: failed: ") && said.contains("terrafarm token"), "{said}");

    let said = succeed(launch().env("TERRAFARM_TOKEN", &token));
    assert!(said.starts_with("pc-two: started, process ") && said.ends_with(", connected\n"));
    let joined = coordinator.expect("worker joined");
    assert!(joined.contains("pc-two"), "{joined}");
    // It is in the worker's surroundings, not in what everyone on that PC may read.
    let pid = said.trim_start_matches("pc-two: started, process ").split(',').next().unwrap();
    let shown = succeed(Command::new("ps").args(["-o", "args=", "-p", pid]));
    assert!(shown.contains("worker") && !shown.contains(&token), "{shown}");
    for file in fs::read_dir(office.dir.path("pc-two").join(".terrafarm")).unwrap() {
        let held = fs::read(file.unwrap().path()).unwrap();
        assert!(!held.windows(token.len()).any(|text| text == token.as_bytes()), "it is on disk");
    }
    assert_eq!(succeed(launch().arg("stop")), "pc-two: stopped\n");
    let (said, _) = run(launch().env("TERRAFARM_TOKEN", "'; reboot"), 2);
    assert!(said.is_empty(), "{said}");
}

#[test]
fn a_worker_that_cannot_reach_its_coordinator_is_named_and_goes_on_trying() {
    let office = Office::new();
    let hosts = office.dir.write("hosts", "pc-two 1\n");
    let launch = || office.launch(&hosts, "127.0.0.1:1");
    let (said, _) = run(launch().args(["--copy", PROGRAM]), 1);
    assert!(said.contains("but not connected to 127.0.0.1:1"), "{said}");
    assert!(succeed(launch().arg("status")).contains("pc-two: running"));
    assert_eq!(succeed(launch().arg("stop")), "pc-two: stopped\n");
}

#[test]
fn nothing_that_a_far_shell_would_understand_gets_into_its_command_line() {
    let office = Office::new();
    let good = office.dir.write("good", "pc-two\n");
    for host in ["-oProxyCommand=sh", "pc;reboot", "pc$(reboot)", "pc two three", "pc 0", "pc -1"] {
        let hosts = office.dir.write("hosts", format!("{host}\n"));
        let (_, said) = run(&mut office.launch(&hosts, "pc-one:7070"), 2);
        assert!(said.starts_with("launch: "), "{host}: {said}");
    }
    for coordinator in ["pc-one", "-v:1", "pc';reboot:1", "$(reboot):1", ""] {
        let (_, said) = run(&mut office.launch(&good, coordinator), 2);
        assert!(said.contains("is no HOST:PORT"), "{coordinator}: {said}");
    }
    run(office.launch(&good, "pc-one:7070").arg("restart"), 2);
    run(&mut office.launch(&office.dir.path("absent"), "pc-one:7070"), 2);
    let empty = office.dir.write("empty", "# nobody\n");
    run(&mut office.launch(&empty, "pc-one:7070"), 2);
    assert!(!office.dir.path("pc-two").exists(), "no host was spoken to");
}

#[test]
fn files_that_the_readme_starts_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = fs::read_to_string(root.join("README.md")).unwrap();
    let lines = readme.lines().filter(|line| !line.starts_with('|') && line.contains("deploy/"));
    let words = lines.flat_map(str::split_whitespace);
    let files: Vec<_> = words.filter(|word| word.starts_with("deploy/")).collect();
    assert!(files.len() >= 7, "{files:?}");
    for file in files {
        assert!(root.join(file).exists(), "{file}");
    }
}

#[test]
fn the_example_of_a_hosts_file_is_one() {
    let office = Office::new();
    let hosts = deploy("ssh/hosts.example");
    let (said, _) = run(office.launch(&hosts, "pc-one:7070").arg("status"), 1);
    assert_eq!(said.lines().count(), 3, "{said}");
}

#[test]
fn shellcheck_has_nothing_to_say_about_the_scripts() {
    if !available("shellcheck") {
        return;
    }
    succeed(Command::new("shellcheck").args([deploy("ssh/launch"), deploy("slurm/worker.sbatch")]));
}
