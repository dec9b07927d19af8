//! What is wrong is said, nothing half-written stays, the exit code is 2.

use crate::support::{Dir, Running, World, coordinator, run, succeed, terrafarm, worker};
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;

/// An import that must fail: the message names what matters and nothing is left.
fn import_fails(name: &str, content: &[u8], extra: &[&str], said: &[&str]) {
    let dir = Dir::new();
    let input = dir.write(name, content);
    let before = dir.names();
    let (_, stderr) = run(
        terrafarm()
            .args(["terrain", "import"])
            .arg(&input)
            .arg("-o")
            .arg(dir.path("x.terrain"))
            .args(extra),
        2,
    );
    for text in said.iter().chain(&[name]) {
        assert!(stderr.contains(text), "{text:?} is not in: {stderr}");
    }
    assert_eq!(dir.names(), before, "something was left behind");
}

#[test]
fn an_hgt_of_the_wrong_size_names_the_sizes_it_may_have() {
    import_fails("N10E010.hgt", &[0; 1000], &[], &["1201", "3601", "1000"]);
}

#[test]
fn a_short_ascii_grid_says_how_many_values_are_missing() {
    let text = "ncols 3\nnrows 3\nxllcorner 500000\nyllcorner 5000000\ncellsize 10\n100 200 300\n400 500 600\n";
    import_fails("short.asc", text.as_bytes(), &["--source-crs", "EPSG:32633"], &["9", "6"]);
}

#[test]
fn declared_sizes_of_10_to_the_9_are_refused_without_memory() {
    let text = "ncols 1000000000\nnrows 1000000000\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n";
    import_fails("vast.asc", text.as_bytes(), &["--source-crs", "EPSG:32633"], &["1000000000"]);
}

#[test]
fn a_grid_without_a_reference_system_says_how_to_give_one() {
    let text = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 4\n";
    import_fails("where.asc", text.as_bytes(), &[], &["--source-crs"]);
}

#[test]
fn an_unknown_reference_system_is_named() {
    let text = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 4\n";
    let dir = Dir::new();
    let input = dir.write("grid.asc", text);
    let (_, stderr) = run(
        terrafarm()
            .args(["terrain", "import", "--source-crs", "EPSG:999999"])
            .arg(&input)
            .arg("-o")
            .arg(dir.path("x.terrain")),
        2,
    );
    assert!(stderr.contains("EPSG:999999"), "{stderr}");
}

#[test]
fn a_file_of_no_known_format_lists_the_known_ones() {
    import_fails("notes.txt", b"hello, this is not elevation\n", &[], &["GeoTIFF"]);
}

#[test]
fn a_missing_file_is_named() {
    let dir = Dir::new();
    let (_, stderr) = run(
        terrafarm()
            .args(["terrain", "import"])
            .arg(dir.path("nowhere.tif"))
            .arg("-o")
            .arg(dir.path("x.terrain")),
        2,
    );
    assert!(stderr.contains("nowhere.tif"), "{stderr}");
}

#[test]
fn a_damaged_store_is_refused_whole() {
    let world = World::new(40);
    let store = world.dir.path("land.terrain");
    let whole = fs::read(&store).unwrap();
    for (damage, said) in [
        (whole[..whole.len() / 2].to_vec(), "land.terrain"),
        (b"not a store at all".to_vec(), "land.terrain"),
        (Vec::new(), "land.terrain"),
    ] {
        fs::write(&store, damage).unwrap();
        let (_, stderr) = run(terrafarm().args(["terrain", "info"]).arg(&store), 2);
        assert!(stderr.contains(said), "{stderr}");
    }
}

#[test]
fn a_corrupt_tile_fails_the_frames_that_need_it_and_says_which() {
    let world = World::new(40);
    let store = world.dir.path("land.terrain");
    let mut bytes = fs::read(&store).unwrap();
    // Tiles come first in the file, the index last: this hits a tile.
    let middle = bytes.len() / 4;
    bytes[middle] ^= 0x55;
    fs::write(&store, bytes).unwrap();
    // Once where the flight asks for the height of the ground, once where rays do.
    let by_height = "t,x,y,z,heading,pitch\n0,200,200,4000,45,-80\n1,210,210,4000,45,-80\n";
    for flight in [fs::read_to_string(&world.flight).unwrap(), by_height.to_owned()] {
        fs::write(&world.flight, flight).unwrap();
        let mut render = world.render();
        render.args(["--size", "64x36", "--frames", "0..2", "--workers", "1", "-o"]);
        let result = render.arg(world.dir.path("out")).output().unwrap();
        let stderr = String::from_utf8(result.stderr).unwrap();
        assert_ne!(result.status.code(), Some(0), "{stderr}");
        assert!(stderr.contains("tile") || stderr.contains("corrupt"), "{stderr}");
    }
}

/// A render that must fail before it starts.
fn render_fails(flight: &str, said: &[&str]) {
    let world = World::new(40);
    fs::write(&world.flight, flight).unwrap();
    let output = world.dir.path("out");
    let (_, stderr) = run(world.render().args(["--workers", "1", "-o"]).arg(&output), 2);
    for text in said {
        assert!(stderr.contains(text), "{text:?} is not in: {stderr}");
    }
    assert!(!output.exists(), "something was left behind");
}

#[test]
fn an_unknown_column_is_named_with_its_line() {
    render_fails("t,x,y,z,heading,pich\n0,1,1,1,0,0\n", &["flight.csv:1", "pich", "pitch"]);
}

#[test]
fn a_number_that_is_none_is_named_with_its_line_and_column() {
    render_fails("t,x,y,z,heading,pitch\n0,1,1,1,0,0\n1,1,nan,1,0,0\n", &["flight.csv:3", "\"y\""]);
}

#[test]
fn a_flight_outside_the_terrain_names_both_places() {
    render_fails("t,x,y,z,heading,pitch\n0,9e6,9e6,100,0,0\n1,9e6,9e6,100,0,0\n", &["outside"]);
}

#[test]
fn a_scene_with_an_unknown_key_is_refused_with_its_line() {
    let world = World::new(40);
    fs::write(&world.scene, "terrain = \"land.terrain\"\n\n[sun]\nazimut = 3\n").unwrap();
    let output = world.dir.path("out");
    let (_, stderr) = run(world.render().arg("-o").arg(&output), 2);
    assert!(stderr.contains("azimut") && stderr.contains('4'), "{stderr}");
}

#[test]
fn an_unknown_method_lists_the_known_ones() {
    let world = World::new(40);
    let (_, stderr) =
        run(world.render().args(["--method", "exat", "-o"]).arg(world.dir.path("o")), 2);
    assert!(stderr.contains("did you mean \"exact\"?"), "{stderr}");
    let (_, stderr) =
        run(world.render().args(["--method", "quickest", "-o"]).arg(world.dir.path("o")), 2);
    assert!(stderr.contains("auto, exact, lod, column"), "{stderr}");
}

#[test]
fn a_tolerance_out_of_its_limits_says_what_they_are() {
    let world = World::new(40);
    for wrong in ["0", "-1", "0.005", "65", "nan", "inf", "some"] {
        for command in [world.render().arg("-o").arg(world.dir.path("o")), terrafarm().arg("demo")]
        {
            let (_, stderr) = run(command.args(["--tolerance", wrong]), 2);
            assert!(stderr.contains("0.01 to 64"), "{wrong}: {stderr}");
        }
    }
    fs::write(&world.scene, "terrain = \"land.terrain\"\n[output]\ntolerance = 0\n").unwrap();
    let (_, stderr) = run(world.render().arg("-o").arg(world.dir.path("o")), 2);
    assert!(stderr.contains("scene.toml:3") && stderr.contains("0.01 to 64"), "{stderr}");
}

#[test]
fn a_share_to_check_that_is_none_says_what_it_may_be() {
    let world = World::new(40);
    for wrong in ["-1", "101%", "all", "nan", "1e-9", ""] {
        let mut render = world.render();
        let (_, stderr) = run(render.args(["--check", wrong, "-o"]).arg(world.dir.path("o")), 2);
        assert!(stderr.contains("0.0001% to 100%"), "{wrong}: {stderr}");
        let (_, stderr) = run(terrafarm().args(["demo", "--check", wrong]), 2);
        assert!(stderr.contains("0.0001% to 100%"), "{wrong}: {stderr}");
    }
}

#[test]
fn a_coordinator_that_is_not_there_is_named() {
    let world = World::new(40);
    let (_, stderr) = run(
        world.render().args(["--coordinator", "127.0.0.1:1", "-o"]).arg(world.dir.path("o")),
        2,
    );
    assert!(stderr.contains("127.0.0.1:1"), "{stderr}");
}

#[test]
fn a_token_that_is_not_there_or_has_a_typo_is_named_and_not_repeated() {
    let dir = Dir::new();
    let file = dir.path("farm.token");
    let token = succeed(terrafarm().args(["token", "--token-file"]).arg(&file));
    let worker = |file: &Path| {
        let mut command = terrafarm();
        command.args(["worker", "--once", "--coordinator", "127.0.0.1:1", "--token-file"]);
        run(command.arg(file), 2).1
    };
    let said = worker(&dir.path("absent"));
    assert!(said.contains("absent") && said.contains("terrafarm token --enter"), "{said}");
    let end = if token.trim().ends_with('Z') { "X" } else { "Z" };
    let typo = format!("{}{end}", &token.trim()[..token.trim().len() - 1]);
    let said = worker(&dir.write("typo.token", &typo));
    assert!(said.contains("group 8 of 8") && !said.contains(&typo), "{said}");
    let said = run(terrafarm().arg("token").env("XDG_CONFIG_HOME", "/dev/null"), 2).1;
    assert!(said.contains("farm.token"), "{said}");
}

#[test]
fn an_output_that_cannot_be_written_is_said_before_rendering() {
    let world = World::new(40);
    let (_, stderr) =
        run(world.render().args(["--workers", "1", "-o", "/proc/terrafarm-nowhere/out.mp4"]), 2);
    assert!(stderr.contains("/proc/terrafarm-nowhere"), "{stderr}");
}

/// A disk of 600 kB, where making one is allowed; unmounted when dropped.
#[cfg(target_os = "linux")]
struct SmallDisk(std::path::PathBuf);

#[cfg(target_os = "linux")]
impl SmallDisk {
    fn mount(at: std::path::PathBuf) -> Option<Self> {
        fs::create_dir(&at).unwrap();
        let mut mount = std::process::Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", "size=600k", "terrafarm-test"]).arg(&at);
        let done = mount.stderr(std::process::Stdio::null()).status();
        done.is_ok_and(|status| status.success()).then_some(SmallDisk(at))
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg(&self.0).status();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_said_and_nothing_half_written_stays() {
    let world = World::new(60);
    let Some(disk) = SmallDisk::mount(world.dir.path("disk")) else {
        println!("skipped: mounting a small disk is not allowed here");
        return;
    };
    let arguments = ["--size", "640x360", "--frames", "0..9", "--workers", "1", "-o"];
    let (_, stderr) = run(world.render().args(arguments).arg(disk.0.join("film.y4m")), 2);
    assert!(stderr.contains("no space") && stderr.contains("film.y4m"), "{stderr}");
    let (_, stderr) = run(
        terrafarm()
            .args(["terrain", "synth", "--size", "1025", "-o"])
            .arg(disk.0.join("x.terrain")),
        2,
    );
    assert!(stderr.contains("x.terrain") && stderr.contains("No space"), "{stderr}");
    assert_eq!(fs::read_dir(&disk.0).unwrap().count(), 0);
}

#[cfg(unix)]
#[test]
fn a_killed_import_leaves_no_store_and_the_next_one_succeeds() {
    let world = World::new(40);
    let store = world.dir.path("big.terrain");
    let mut synth = terrafarm();
    synth.args(["terrain", "synth", "--size", "1500", "-o"]).arg(&store);
    let mut running = Running::start(&mut synth);
    running.kill();
    assert!(!store.exists());
    let mut again = terrafarm();
    succeed(again.args(["terrain", "synth", "--size", "20", "-o"]).arg(&store));
    succeed(terrafarm().args(["terrain", "info"]).arg(&store));
}

/// Says something to a coordinator that no peer would say; the coordinator must close the
/// connection and go on serving others.
fn coordinator_survives(bytes: &[u8]) {
    let (_coordinator, address) = coordinator();
    let mut peer = TcpStream::connect(&address).unwrap();
    peer.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    // The far side may close before everything is written: that is fine.
    let _ = peer.write_all(bytes);
    let mut answer = Vec::new();
    let _ = peer.read_to_end(&mut answer);
    let world = World::new(40);
    let mut good = worker(&address, "good");
    let render = Running::start(
        world
            .render()
            .args(["--size", "64x36", "--frames", "0..2", "--coordinator", &address, "-o"])
            .arg(world.dir.path("out")),
    );
    good.expect("job begins");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
}

#[test]
fn a_peer_that_speaks_garbage_harms_nobody() {
    coordinator_survives(b"GET / HTTP/1.1\r\nHost: farm\r\n\r\n");
    coordinator_survives(&[0xff; 4096]);
}

#[test]
fn a_peer_that_declares_vast_lengths_harms_nobody() {
    // A sound start of a frame, then lengths of 2^32 - 1.
    let mut frame = terrafarm_wire::frame::MAGIC.to_vec();
    frame.extend([0xff; 60]);
    coordinator_survives(&frame);
}

#[test]
fn an_existing_store_is_not_replaced_unless_asked() {
    let dir = Dir::new();
    let store = dir.write("x.terrain", "precious");
    let mut synth = terrafarm();
    synth.args(["terrain", "synth", "--size", "20", "-o"]).arg(&store);
    let (_, stderr) = run(&mut synth, 2);
    assert!(stderr.contains("--force"), "{stderr}");
    assert_eq!(fs::read(&store).unwrap(), b"precious");
    succeed(synth.arg("--force"));
    assert_ne!(fs::read(&store).unwrap(), b"precious");
}
