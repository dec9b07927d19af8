//! A real night on record plays again, whether its coordinator was stopped or killed.

use crate::support::{Running, World, frame_hashes, run, succeed, terrafarm, worker};
use std::fs;
use std::path::Path;

const SIZE: [&str; 6] = ["--size", "192x108", "--fps", "30", "--split", "tiles:32"];
/// Two seconds of flight, both ends.
const FRAMES: usize = 61;

fn coordinator(journal: &Path) -> (Running, String) {
    let mut command = terrafarm();
    command.args(["-v", "coordinator", "--no-http", "--listen", "127.0.0.1:0", "--journal"]);
    let mut running = Running::start(command.arg(journal).args(["--audit", "5"]));
    let line = running.expect("coordinator on ");
    let address = line.rsplit(' ').next().unwrap().to_owned();
    (running, address)
}

fn replay(journal: &Path, json: &Path) -> (String, serde_json::Value) {
    let mut command = terrafarm();
    command.args(["simulate", "--replay"]).arg(journal).arg("--json").arg(json);
    let said = succeed(&mut command);
    (said, serde_json::from_slice(&fs::read(json).unwrap()).unwrap())
}

#[test]
fn a_night_with_a_killed_worker_plays_again_from_its_journal() {
    let world = World::new(300);
    let journal = world.dir.path("night.journal");
    let (mut running, address) = coordinator(&journal);
    running.expect("journal:             in ");
    let mut one = worker(&address, "one");
    let output = world.dir.path("film");
    let mut render = world.render();
    render.args(SIZE).args(["--coordinator", &address, "-o"]).arg(&output);
    let render = Running::start(&mut render);
    // Alone, it holds a job at any moment before the film is done.
    one.expect("job begins");
    one.kill();
    let _two = worker(&address, "two");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&output.join("manifest.json")).len(), FRAMES);
    #[cfg(unix)]
    {
        running.signal("TERM");
        assert_eq!(running.finish().0, Some(0));
        let (said, report) = replay(&journal, &world.dir.path("report.json"));
        assert!(said.contains("the same ") && said.contains("all invariants hold"), "{said}");
        assert_eq!(report["frames"], FRAMES);
        assert_eq!(report["proved"], report["events"], "a journal that is ended proves all");
        // At most one at once: the second came when the first was dead.
        assert!(
            report["workers"] == 1 && report["account"]["lost"].as_u64().unwrap() >= 1,
            "{report}"
        );
        assert!(report["torn"].is_null());
    }
}

#[test]
fn a_killed_coordinator_leaves_a_journal_that_plays_to_its_torn_end() {
    let world = World::new(300);
    let journal = world.dir.path("night.journal");
    let (mut running, address) = coordinator(&journal);
    let _worker = worker(&address, "one");
    let mut render = world.render();
    render.args(SIZE).args(["--coordinator", &address, "-o"]).arg(world.dir.path("film"));
    let (code, lines) = Running::start(&mut render).finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    running.kill();
    let (said, report) = replay(&journal, &world.dir.path("report.json"));
    assert!(said.contains("the same "), "{said}");
    let events = report["events"].as_u64().unwrap();
    assert!(events > 10, "{events} events were written before the kill");

    // Wherever the last write was cut off.
    let whole = fs::read(&journal).unwrap();
    let torn = world.dir.write("torn.journal", &whole[..whole.len() - 3]);
    let (said, report) = replay(&torn, &world.dir.path("torn.json"));
    assert!(said.contains("was not written to its end") && said.contains("the same "), "{said}");
    assert!(report["torn"]["bytes"].as_u64().unwrap() > 0);

    // The next coordinator leaves it as it is.
    let (mut next, _) = coordinator(&journal);
    let line = next.expect("journal:             in ");
    assert!(line.ends_with("night-2.journal"), "{line}");
    assert_eq!(fs::read(&journal).unwrap(), whole);
}

#[test]
fn a_journal_that_cannot_be_written_keeps_the_coordinator_from_starting() {
    let world = World::new(64);
    let mut command = terrafarm();
    command.args(["coordinator", "--no-http", "--listen", "127.0.0.1:0", "--journal"]);
    let (printed, said) = run(command.arg(world.dir.path("nowhere/night.journal")), 2);
    assert!(said.contains("is its folder there"), "{said}");
    assert_eq!(printed, "", "nobody is told of a coordinator that does not serve");
}
