//! A fresh folder and the program, as a test needs them.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// How long anything may take before a test gives up on it. Generous: it only ends tests
/// that have failed already.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// A folder that goes away with the test.
pub struct Dir(tempfile::TempDir);

impl Dir {
    pub fn new() -> Self {
        Dir(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, content).unwrap();
        path
    }

    /// Names of everything in the folder, sorted.
    pub fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

/// The program.
pub fn terrafarm() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_terrafarm"));
    command.stdin(Stdio::null());
    for farm in ["TERRAFARM_COORDINATOR", "TERRAFARM_TOKEN", "TERRAFARM_DATA"] {
        command.env_remove(farm);
    }
    // The farm of whoever runs the tests is none of theirs.
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR")).join("no-configuration");
    command.env("HOME", &nowhere).env("XDG_CONFIG_HOME", nowhere);
    command
}

/// Runs to the end and returns what was printed; fails the test on another exit code.
pub fn run(command: &mut Command, code: i32) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert_eq!(
        status.code(),
        Some(code),
        "{command:?}\n--- stdout\n{stdout}\n--- stderr\n{stderr}"
    );
    (stdout, stderr)
}

/// Runs a command that must succeed and returns its standard output.
pub fn succeed(command: &mut Command) -> String {
    run(command, 0).0
}

/// Small procedural terrain with a scene and a flight over it.
pub struct World {
    pub dir: Dir,
    pub scene: PathBuf,
    pub flight: PathBuf,
}

impl World {
    pub fn new(posts: u32) -> Self {
        let dir = Dir::new();
        let store = dir.path("land.terrain");
        succeed(
            terrafarm()
                .args(["terrain", "synth", "--spacing", "30", "--seed", "7", "--size"])
                .arg(posts.to_string())
                .arg("-o")
                .arg(&store),
        );
        let scene =
            dir.write("scene.toml", "terrain = \"land.terrain\"\n[haze]\nvisibility_km = 40\n");
        let span = f64::from(posts - 1) * 30.0;
        let flight = dir.write(
            "flight.csv",
            format!(
                "t,x,y,agl,heading,pitch,roll,hfov\n0,{a},{a},300,45,-20,0,60\n2,{b},{b},400,60,-25,10,60\n",
                a = span * 0.1,
                b = span * 0.3
            ),
        );
        World { dir, scene, flight }
    }

    /// `terrafarm render` of this world to a new folder, without the output argument.
    pub fn render(&self) -> Command {
        let mut command = terrafarm();
        command.arg("render").arg(&self.scene).arg("--flight").arg(&self.flight);
        command
    }
}

/// SHA-256 of every frame, in order, as the manifest of a render says.
pub fn frame_hashes(manifest: &Path) -> Vec<String> {
    let text = fs::read_to_string(manifest).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    let frames = manifest["frames"].as_array().unwrap();
    for (index, frame) in frames.iter().enumerate() {
        assert_eq!(frame["index"].as_u64(), Some(index as u64));
    }
    frames.iter().map(|frame| frame["sha256"].as_str().unwrap().to_owned()).collect()
}

/// A process that runs beside the test and is killed with it. Its lines, of both streams,
/// are read as they come.
pub struct Running {
    child: Child,
    lines: Receiver<String>,
    seen: Vec<String>,
}

impl Running {
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (sender, lines) = channel();
        let stdout: ChildStdout = child.stdout.take().unwrap();
        let stderr = child.stderr.take().unwrap();
        let from_stderr = sender.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(stderr).lines().map_while(Result::ok) {
                let _ = from_stderr.send(line);
            }
        });
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                let _ = sender.send(line);
            }
        });
        Running { child, lines, seen: Vec::new() }
    }

    /// Waits for a line that contains a text, and returns it.
    pub fn expect(&mut self, text: &str) -> String {
        self.expect_one_of(&[text])
    }

    /// Waits for a line that contains one of these texts, and returns it.
    pub fn expect_one_of(&mut self, texts: &[&str]) -> String {
        self.seek(texts, PATIENCE).unwrap_or_else(|why| {
            let how =
                if why == RecvTimeoutError::Timeout { "did not come" } else { "ended before" };
            panic!("{texts:?} {how}; lines so far:\n{}", self.seen.join("\n"));
        })
    }

    /// Waits for a line that contains a text, but it need not come; `None` if it does not in
    /// this time.
    #[cfg(unix)]
    pub fn expect_within(&mut self, text: &str, limit: Duration) -> Option<String> {
        self.seek(&[text], limit).ok()
    }

    fn seek(&mut self, texts: &[&str], limit: Duration) -> Result<String, RecvTimeoutError> {
        let deadline = Instant::now() + limit;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self.lines.recv_timeout(left)?;
            self.seen.push(line.clone());
            if texts.iter().any(|text| line.contains(text)) {
                return Ok(line);
            }
        }
    }

    /// Waits for the end; returns the exit code and every line.
    pub fn finish(mut self) -> (Option<i32>, Vec<String>) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(line) => self.seen.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    panic!("does not end; lines so far:\n{}", self.seen.join("\n"))
                }
            }
        }
        let code = self.child.wait().unwrap().code();
        (code, std::mem::take(&mut self.seen))
    }

    /// The number of the process.
    #[cfg(target_os = "linux")]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// kill -9.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    #[cfg(unix)]
    pub fn signal(&self, name: &str) {
        let status =
            Command::new("kill").arg(format!("-{name}")).arg(self.child.id().to_string()).status();
        assert!(status.unwrap().success());
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A coordinator of its own process, and its address.
pub fn coordinator() -> (Running, String) {
    coordinator_on("127.0.0.1:0")
}

/// A coordinator of its own process at an address, and the address with its port.
pub fn coordinator_on(listen: &str) -> (Running, String) {
    let mut running =
        Running::start(terrafarm().args(["-v", "coordinator", "--listen", listen, "--no-http"]));
    let line = running.expect("coordinator on ");
    let address = line.rsplit(' ').next().unwrap().to_owned();
    (running, address)
}

/// A coordinator with a token, which is made in this folder; its address and its token.
#[cfg(unix)]
pub fn coordinator_with_token(dir: &Dir) -> (Running, String, String) {
    let file = dir.path("farm.token");
    let mut command = terrafarm();
    command.args(["-v", "coordinator", "--listen", "127.0.0.1:0", "--no-http", "--token-file"]);
    let mut running = Running::start(command.arg(&file));
    let line = running.expect("coordinator on ");
    let address = line.rsplit(' ').next().unwrap().to_owned();
    let token = fs::read_to_string(file).unwrap().trim().to_owned();
    (running, address, token)
}

/// A worker of its own process, one thread, no disk cache.
pub fn worker(address: &str, name: &str) -> Running {
    Running::start(terrafarm().args([
        "-vv",
        "worker",
        "--coordinator",
        address,
        "--threads",
        "1",
        "--cache-limit",
        "0",
        "--name",
        name,
    ]))
}

/// `../shared/data` beside the checkout, if it is there; says so if not.
pub fn shared_data() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: there is no ../shared/data");
    None
}
