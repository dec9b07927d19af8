//! `deploy/slurm/worker.sbatch` on a real Slurm: one controller and eight nodes as plain
//! processes of this PC, without munge, cgroups or systemd.
//!
//! Slurm kills and requeues on its own terms; what is promised is that a crew is there
//! within seconds and that nothing Slurm does to it shows in a picture.

use crate::support::{
    Dir, PATIENCE, Running, World, coordinator_with_token, frame_hashes, succeed,
};
use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

const NODES: usize = 8;

/// Tries until something comes of it; fails the test when it takes too long.
fn poll<T>(what: &str, mut attempt: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = attempt() {
            return found;
        }
        assert!(Instant::now() < deadline, "{what} did not come about");
        // Slurm tells nobody: it has to be asked again, and not without a breath between.
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Whether Slurm is here and may run; says so if not. Where CI asks for oracles
/// (`TERRAFARM_REQUIRE_ORACLES`), root without Slurm is a failure.
fn available() -> bool {
    let user = Command::new("id").arg("-u").output().unwrap();
    if user.stdout != b"0\n" {
        println!("skipped: slurmd wants to be root");
        return false;
    }
    let there = |tool: &&str| Command::new(tool).arg("-V").output().is_ok();
    let tools = ["slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "squeue", "sinfo"];
    let missing: Vec<_> = tools.into_iter().filter(|tool| !there(tool)).collect();
    if missing.is_empty() {
        return true;
    }
    let required = std::env::var_os("TERRAFARM_REQUIRE_ORACLES").is_some();
    assert!(!required, "not on PATH: {missing:?}");
    println!("skipped: not on PATH: {}", missing.join(", "));
    false
}

/// A cluster of one PC.
struct Cluster {
    dir: Dir,
    config: PathBuf,
    controller: Option<Running>,
    nodes: BTreeMap<String, Running>,
}

impl Cluster {
    fn start() -> Self {
        let dir = Dir::new();
        let config = dir.path("slurm.conf");
        fs::create_dir(dir.path("state")).unwrap();
        // All held until all are known: no port is given out twice.
        let held: Vec<_> = (0..=NODES).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        let mut ports = held.iter().map(|socket| socket.local_addr().unwrap().port());
        let host = succeed(Command::new("hostname").arg("-s"));
        let (host, root) = (host.trim(), dir.path(""));
        let (root, port) = (root.to_str().unwrap().trim_end_matches('/'), ports.next().unwrap());
        let mut text = format!(
            "ClusterName=office\nSlurmctldHost={host}(127.0.0.1)\nSlurmctldPort={port}\n\
             SlurmUser=root\nSlurmdUser=root\nAuthType=auth/none\nCredType=cred/none\n\
             ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\n\
             SlurmdParameters=config_overrides\nSelectType=select/cons_tres\n\
             SelectTypeParameters=CR_CPU\nMpiDefault=none\nSwitchType=switch/none\n\
             JobAcctGatherType=jobacct_gather/none\n\
             AccountingStorageType=accounting_storage/none\nReturnToService=2\n\
             SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,sched_interval=1\n\
             SlurmctldPidFile={root}/slurmctld.pid\nSlurmdPidFile={root}/slurmd-%n.pid\n\
             StateSaveLocation={root}/state\nSlurmdSpoolDir={root}/spool-%n\n\
             SlurmctldLogFile={root}/slurmctld.log\nSlurmdLogFile={root}/slurmd-%n.log\n"
        );
        let names: Vec<_> = (1..=NODES).map(|number| format!("n{number}")).collect();
        for (name, port) in names.iter().zip(ports) {
            fs::create_dir(dir.path(&format!("spool-{name}"))).unwrap();
            text.push_str(&format!(
                "NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs=1\n"
            ));
        }
        text.push_str("PartitionName=office Nodes=ALL Default=YES MaxTime=INFINITE State=UP\n");
        fs::write(&config, text).unwrap();
        drop(held);
        let mut cluster = Cluster { dir, config, controller: None, nodes: BTreeMap::new() };
        cluster.controller = Some(Running::start(cluster.slurm("slurmctld").arg("-D")));
        for name in &names {
            cluster.start_node(name);
        }
        poll("a cluster of idle nodes", || {
            let sinfo = cluster.slurm("sinfo").args(["-h", "-N", "-o", "%T"]).output().unwrap();
            let states = String::from_utf8(sinfo.stdout).unwrap();
            (states.lines().filter(|state| *state == "idle").count() == NODES).then_some(())
        });
        cluster
    }

    /// A program of Slurm, told about this cluster.
    fn slurm(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", &self.config);
        command
    }

    fn start_node(&mut self, name: &str) {
        let node = Running::start(self.slurm("slurmd").args(["-D", "-N", name]));
        self.nodes.insert(name.to_owned(), node);
    }

    /// Submits the crew. Its program says everything, leaves its process number in a file
    /// named for its job, and ends with the coordinator. The farm's token is nowhere but in
    /// the variable that Slurm hands on.
    fn submit(&self, address: &str, token: &str) {
        let folder = self.dir.path("");
        let program = self.dir.write(
            "terrafarm",
            format!(
                "#!/bin/sh\necho $$ > \"{}/pid-$SLURM_JOB_ID\"\nexec {} -vv \"$@\" --once\n",
                folder.display(),
                env!("CARGO_BIN_EXE_terrafarm")
            ),
        );
        succeed(Command::new("chmod").arg("+x").arg(&program));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/slurm/worker.sbatch");
        let export = format!(
            "--export=ALL,TERRAFARM_COORDINATOR={address},TERRAFARM={},TERRAFARM_CACHE={}",
            program.display(),
            self.dir.path("cache").display()
        );
        let array = format!("--array=1-{NODES}");
        let log = self.dir.path("%A_%a.log");
        let mut sbatch = self.slurm("sbatch");
        sbatch.env("TERRAFARM_TOKEN", token).args([&array, &export, "-o"]);
        succeed(sbatch.arg(log).arg(script));
    }

    /// Job and node of every worker that Slurm says runs.
    fn running(&self) -> Vec<(String, String)> {
        let states = ["-h", "-r", "-t", "RUNNING", "-o", "%A %N"];
        let lines = succeed(self.slurm("squeue").args(states));
        let pair = |line: &str| {
            let (job, node) = line.split_once(' ').unwrap();
            (job.to_owned(), node.to_owned())
        };
        lines.lines().map(pair).collect()
    }

    /// What Slurm says about a job.
    fn job(&self, job: &str) -> String {
        succeed(self.slurm("scontrol").args(["show", "job", job]))
    }

    /// Ends every job and waits until none is left.
    fn cancel_all(&self) {
        succeed(self.slurm("scancel").args(["--name", "terrafarm"]));
        poll("an empty queue", || succeed(self.slurm("squeue").arg("-h")).is_empty().then_some(()));
    }

    /// How often any worker has begun a job.
    fn jobs_begun(&self) -> usize {
        let logs = self.dir.names().into_iter().filter(|name| name.contains('_'));
        logs.map(|name| {
            let log = fs::read_to_string(self.dir.path(&name)).unwrap_or_default();
            log.matches("job begins").count()
        })
        .sum()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        // Daemons go with their guards; jobs would outlive them after a failed test.
        let _ =
            self.slurm("scancel").args(["--full", "-s", "KILL", "--name", "terrafarm"]).output();
    }
}

/// Starts a crew of all nodes; returns how long it took until the last had registered.
fn crew(cluster: &Cluster, coordinator: &mut Running, address: &str, token: &str) -> Duration {
    let since = Instant::now();
    cluster.submit(address, token);
    for _ in 0..NODES {
        coordinator.expect("worker joined");
    }
    since.elapsed()
}

#[test]
fn a_crew_under_slurm_is_there_in_5_seconds_and_survives_what_slurm_does_to_it() {
    if !available() {
        return;
    }
    let world = World::new(300);
    let size = ["--size", "384x216", "--fps", "4", "--samples", "2", "--split", "tiles:32"];
    let calm = world.dir.path("calm");
    succeed(world.render().args(size).args(["--workers", "1", "-o"]).arg(&calm));

    let mut cluster = Cluster::start();
    let (mut coordinator, address, token) = coordinator_with_token(&world.dir);
    // A PC that is busy with other tests gets five attempts.
    let attempts = (1..=5).map(|attempt| {
        if attempt > 1 {
            cluster.cancel_all();
        }
        let took = crew(&cluster, &mut coordinator, &address, &token);
        println!("attempt {attempt}: {NODES} workers registered after {took:?}");
        took
    });
    assert!(attempts.into_iter().any(|took| took <= Duration::from_secs(5)));
    let jobs = poll("a crew that runs", || {
        let jobs = cluster.running();
        (jobs.len() == NODES).then_some(jobs)
    });

    let output = world.dir.path("farm");
    let manifest = output.join("manifest.json");
    let render = Running::start(
        world
            .render()
            .args(size)
            .env("TERRAFARM_TOKEN", &token)
            .args(["--coordinator", &address, "-o"])
            .arg(&output),
    );
    poll("a shot under way", || (cluster.jobs_begun() > 2 * NODES).then_some(()));

    // A worker dies, the daemon of another's node dies, a third worker is requeued.
    let [(dead, dead_node), (_, orphan_node), (moved, moved_node), (ended, _)] = &jobs[..4] else {
        panic!("there are {NODES} jobs")
    };
    let pid = fs::read_to_string(cluster.dir.path(&format!("pid-{dead}"))).unwrap();
    succeed(Command::new("kill").args(["-9", pid.trim()]));
    cluster.nodes.get_mut(orphan_node).unwrap().kill();
    let drain = format!("NodeName={moved_node}");
    succeed(cluster.slurm("scontrol").args(["update", &drain, "State=DRAIN", "Reason=test"]));
    succeed(cluster.slurm("scontrol").args(["requeue", moved]));
    assert!(!manifest.exists(), "all of it happened in mid-shot");
    // In the order in which a busy PC ends them. The orphan is neither.
    let mut gone = [coordinator.expect("worker l"), coordinator.expect("worker l")];
    gone.sort_by_key(|line| line.contains("worker lost"));
    assert!(gone[0].contains("worker left") && gone[0].contains(moved_node), "{gone:#?}");
    assert!(gone[1].contains("worker lost") && gone[1].contains(dead_node), "{gone:#?}");

    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&manifest), frame_hashes(&calm.join("manifest.json")));
    nothing_twice(&manifest);

    // The daemon comes back and finds its worker working; the requeued one is placed on
    // the node that the dead one left, because its own is drained.
    cluster.start_node(orphan_node);
    poll("the end of the dead worker's job", || {
        cluster.job(dead).contains("JobState=FAILED").then_some(())
    });
    poll("a requeued job that may start", || {
        let pending = cluster.job(moved).contains("JobState=PENDING");
        pending.then_some(())
    });
    let now = format!("JobId={moved}");
    succeed(cluster.slurm("scontrol").args(["update", &now, "StartTime=now"]));
    let joined = coordinator.expect("worker joined");
    assert!(joined.contains(&format!("{dead_node}-{moved}")), "{joined}");

    // What the time limit sends, and what scancel sends.
    succeed(cluster.slurm("scancel").args(["--batch", "--signal=TERM", ended]));
    coordinator.expect("worker left");
    poll("a completed job", || {
        let job = cluster.job(ended);
        let completed = job.contains("JobState=COMPLETED") && job.contains("ExitCode=0:0");
        completed.then_some(())
    });
    poll("every node's answer", || {
        let silent = ["-h", "-N", "-n", orphan_node, "-o", "%T"];
        let state = succeed(cluster.slurm("sinfo").args(silent));
        (state.trim() == "allocated").then_some(())
    });
    let last: Vec<_> = cluster.running();
    assert_eq!(last.len(), NODES - 2, "{last:?}");
    cluster.cancel_all();
    for _ in &last {
        coordinator.expect("worker left: said goodbye");
    }
    for (job, _) in &last {
        let said = cluster.job(job);
        assert!(said.contains("ExitCode=0:0"), "{said}");
    }
}

/// The jobs that frames were made of are those that workers are thanked for.
fn nothing_twice(manifest: &Path) {
    let text = fs::read_to_string(manifest).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    let sum = |key: &str| -> u64 {
        let parts = manifest[key].as_array().unwrap();
        parts.iter().map(|part| part["jobs"].as_u64().unwrap()).sum()
    };
    assert!(sum("frames") > 0);
    assert_eq!(sum("frames"), sum("workers"));
    assert_eq!(manifest["failed"], serde_json::json!({}));
}

#[test]
fn the_job_script_says_what_it_lacks() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/slurm/worker.sbatch");
    let mut command = Command::new("sh");
    let ended = command.arg(script).env_remove("TERRAFARM_COORDINATOR").output().unwrap();
    let said = String::from_utf8(ended.stderr).unwrap();
    assert!(!ended.status.success() && said.contains("HOST:PORT"), "{said}");
}
