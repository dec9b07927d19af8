//! The coordinator's API by real HTTP and over the link of the farm: what it answers, whom
//! it lets in, and how soon.

use crate::office::{SIZE, crowd, first_events, http, office, tiny};
use crate::support::{Dir, Running, World, frame_hashes, run, succeed, terrafarm, worker};
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::time::{Duration, Instant};
use terrafarm_coordinator::Config;
use terrafarm_coordinator::ask::Line;
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::link::Trust;

#[test]
fn a_submitted_shot_is_rendered_without_its_submitter_and_fetched_as_a_local_render_makes_it() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let shot = office.submit(&world, &["--film", "mp4", "--name", "valley"]);
    let _worker = worker(&office.address, "one");
    let path = format!("/api/v1/shots/{shot}");
    let done = office.wait(&path, |shot| shot["state"] == "done");
    assert_eq!((done["name"].as_str(), done["frames_done"].as_u64()), (Some("valley"), Some(9)));
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let fetched = world.dir.path("fetched");
    let number = shot.to_string();
    let fetch = || {
        let mut command = office.ask(&["fetch", &number]);
        command.arg("-o").arg(&fetched);
        command
    };
    succeed(&mut fetch());
    let hashes = |folder: &Path| frame_hashes(&folder.join("manifest.json"));
    assert_eq!(hashes(&fetched), hashes(&calm));
    // One picture is damaged, one is half there: both are made whole.
    std::fs::write(fetched.join("frame_00003.png"), b"nothing").unwrap();
    let whole = std::fs::read(fetched.join("frame_00005.png")).unwrap();
    std::fs::remove_file(fetched.join("frame_00005.png")).unwrap();
    std::fs::write(fetched.join("frame_00005.png.part"), &whole[..whole.len() / 2]).unwrap();
    succeed(&mut fetch());
    assert_eq!(std::fs::read(fetched.join("frame_00005.png")).unwrap(), whole);
    succeed(terrafarm().arg("compare").arg(&fetched).arg(&calm));
    // By HTTP, the same bytes; by range, a part of them.
    let frame = office.get(&format!("{path}/frames/5.png"));
    assert_eq!((frame.status, frame.header("content-type")), (200, Some("image/png")));
    assert_eq!(frame.body, whole);
    let part = http(
        &office.http,
        "GET",
        &format!("{path}/frames/5.png"),
        &[("Range", "bytes=10-19")],
        b"",
    );
    assert_eq!((part.status, &part.body[..]), (206, &whole[10..20]));
    assert_eq!(part.header("content-range").unwrap(), format!("bytes 10-19/{}", whole.len()));
    assert_eq!(office.json(&path)["film"], true);
    let film = world.dir.path("film.mp4");
    succeed(office.ask(&["fetch", &number]).arg("-o").arg(&film));
    assert_eq!(std::fs::read(&film).unwrap(), office.get(&format!("{path}/film.mp4")).body);
    let last = office.get(&format!("{path}/last.jpg"));
    assert_eq!((last.status, last.header("content-type")), (200, Some("image/jpeg")));
    assert_eq!(last.body[..2], [0xff, 0xd8]);
}

#[test]
fn orders_by_http_and_by_command_take_effect_and_say_so() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let shot = office.submit(&world, &["--name", "orders"]);
    let path = format!("/api/v1/shots/{shot}");
    let post = |what: &str| http(&office.http, "POST", &format!("{path}/{what}"), &[], b"");
    assert_eq!(post("pause").status, 200);
    assert_eq!(office.json(&path)["state"], "paused");
    let why = office.json(&format!("{path}/frames/3/why"));
    assert!(why["why"].as_str().unwrap().contains("paused"), "{why}");
    let number = shot.to_string();
    let said = succeed(&mut office.ask(&["why", &number, "3"]));
    assert!(said.contains("frame 3: ") && said.contains("paused"), "{said}");
    succeed(&mut office.ask(&["resume", &number]));
    assert_ne!(office.json(&path)["state"], "paused");
    succeed(&mut office.ask(&["priority", &number, "-7"]));
    assert_eq!(office.json(&path)["priority"], -7);
    let body = br#"{"priority": 12}"#;
    assert_eq!(http(&office.http, "PUT", &format!("{path}/priority"), &[], body).status, 200);
    let listed = succeed(&mut office.ask(&["shots", "--json"]));
    let listed: serde_json::Value = serde_json::from_str(&listed).unwrap();
    assert_eq!(listed["shots"][0]["priority"], 12);
    succeed(&mut office.ask(&["cancel", &number]));
    assert_eq!(office.json(&path)["state"], "canceled");
    assert_eq!(office.json(&path)["film"], false);
    assert_eq!(post("resume").status, 409, "it is over");
    let over = office.json("/api/v1/shots?state=over");
    assert_eq!((over["total"].as_u64(), over["shots"][0]["id"].as_u64()), (Some(1), Some(shot)));
    assert_eq!(office.json("/api/v1/shots?state=active")["total"], 0);
}

#[test]
fn a_worker_is_listed_by_name_and_leaves_when_it_is_told_to() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let leaving = worker(&office.address, "leaving");
    let one = office.wait("/api/v1/workers", |list| list["total"] == 1);
    let one = &one["workers"][0];
    assert_eq!((one["name"].as_str(), one["state"].as_str()), (Some("leaving"), Some("idle")));
    assert!(succeed(&mut office.ask(&["workers"])).contains("leaving"));
    let (_, said) = run(&mut office.ask(&["drain", "nobody"]), 2);
    assert!(said.contains("no worker is called nobody"), "{said}");
    let said = succeed(&mut office.ask(&["clear", "leaving"]));
    assert!(said.contains("is trusted and gets jobs of every shot again"), "{said}");
    let (_, said) = run(&mut office.ask(&["clear", "leaving", "--shot", "7"]), 2);
    assert!(said.contains("shot-7 is not under way"), "{said}");
    let told = office.wait("/api/v1/workers", |list| !list["workers"][0]["cache"].is_null());
    let (one, cache) = (&told["workers"][0], &told["workers"][0]["cache"]);
    assert_eq!((&one["threads"], &one["threads_allowed"]), (&1.into(), &1.into()));
    assert_eq!((&cache["disk_limit_bytes"], &cache["damaged"]), (&0.into(), &0.into()));
    assert_eq!(cache["memory_limit_bytes"], 1u64 << 30);
    assert!(office.get("/metrics").text().contains("terrafarm_blobs_damaged_total 0"));
    succeed(&mut office.ask(&["drain", "leaving"]));
    let (code, lines) = leaving.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    office.wait("/api/v1/workers", |list| list["total"] == 0);
}

#[test]
fn what_cannot_be_answered_is_refused_as_json_with_the_right_status() {
    let dir = Dir::new();
    let office = office(&dir, &[]);
    let long = format!("/api/v1/shots/{}", "9".repeat(30));
    let large = vec![b' '; 1 << 20];
    let hash = "0".repeat(64);
    let blob = format!("/api/v1/blobs/{hash}");
    let cases: &[(&str, &str, &[u8], u16)] = &[
        ("GET", "/nothing", b"", 404),
        ("GET", "/api/v1/shots/17", b"", 404),
        ("GET", "/api/v1/shots/x", b"", 400),
        ("GET", &long, b"", 400),
        ("GET", "/api/v1/shots/17/frames/0.png", b"", 404),
        ("GET", "/api/v1/shots/17/frames/..%2f..%2fqueue.redb", b"", 404),
        ("GET", "/api/v1/shots/17/last.jpg", b"", 404),
        ("GET", "/api/v1/shots?state=asleep", b"", 400),
        ("GET", "/api/v1/shots?offset=-1", b"", 400),
        ("GET", "/api/v1/events?shots_state=asleep", b"", 400),
        ("POST", "/api/v1/shots/17/pause", b"", 404),
        ("DELETE", "/api/v1/shots/17", b"", 405),
        ("GET", "/api/v1/shots/17/pause", b"", 405),
        ("PUT", "/api/v1/shots/17/priority", b"{}", 400),
        ("PUT", "/api/v1/shots/17/priority", br#"{"priority": 99999999999}"#, 400),
        ("PUT", "/api/v1/shots/17/priority", &large, 413),
        ("POST", "/api/v1/workers/17/drain", b"", 404),
        ("POST", "/api/v1/shots", b"{", 400),
        ("POST", "/api/v1/shots", br#"{"name": "x"}"#, 400),
        ("POST", "/api/v1/blobs/missing", b"[1]", 400),
        ("POST", "/api/v1/blobs/missing", br#"["00"]"#, 400),
        ("PUT", "/api/v1/blobs/00", b"x", 400),
        ("PUT", &blob, b"something else", 400),
    ];
    for (method, path, body, status) in cases {
        let reply = http(&office.http, method, path, &[], body);
        assert_eq!(reply.status, *status, "{method} {path}: {}", reply.text());
        assert_eq!(reply.header("content-type"), Some("application/json"), "{method} {path}");
        let error = reply.json()["error"].as_str().unwrap_or_default().to_owned();
        assert!(!error.is_empty() && !error.contains('\n'), "{method} {path}: {error:?}");
        assert_eq!(reply.header("x-content-type-options"), Some("nosniff"));
    }
    let health = office.get("/healthz");
    assert_eq!((health.status, health.json()["status"].as_str()), (200, Some("serving")));
    let metrics = office.get("/metrics").text();
    for line in metrics.lines().filter(|line| !line.starts_with('#')) {
        let (name, value) = line.rsplit_once(' ').unwrap();
        assert!(name.starts_with("terrafarm_") && value.parse::<f64>().is_ok(), "{line}");
    }
    assert!(metrics.contains("terrafarm_shots{state=\"waiting\"} 0"), "{metrics}");
}

#[test]
fn a_coordinator_without_a_queue_says_how_to_get_one() {
    let world = World::new(300);
    let (_running, address) = crate::support::coordinator();
    let mut submit = terrafarm();
    submit.arg("submit").arg(&world.scene).arg("--flight").arg(&world.flight);
    let (_, said) = run(submit.args(["--coordinator", &address]), 2);
    assert!(said.contains("--data"), "{said}");
    assert!(succeed(terrafarm().args(["shots", "--coordinator", &address])).contains("no shots"));
}

#[test]
fn strange_pages_in_a_browser_are_refused() {
    let dir = Dir::new();
    let office = office(&dir, &[]);
    let status = |method: &str, more: &[(&str, &str)]| {
        http(&office.http, method, "/api/v1/farm", more, b"").status
    };
    assert_eq!(status("GET", &[("Host", "rebound.example:7071")]), 421);
    assert_eq!(status("GET", &[("Host", "localhost:7071")]), 200);
    let pause = |more: &[(&str, &str)]| {
        http(&office.http, "POST", "/api/v1/shots/1/pause", more, b"").status
    };
    let own = format!("http://{}", office.http);
    assert_eq!(pause(&[("Origin", "https://evil.example")]), 403);
    assert_eq!(pause(&[("Origin", "null")]), 403);
    assert_eq!(pause(&[("Sec-Fetch-Site", "cross-site")]), 403);
    assert_eq!(pause(&[("Origin", &own), ("Sec-Fetch-Site", "same-origin")]), 404, "no such shot");
    let reply = office.get("/");
    assert!(reply.header("content-security-policy").unwrap().contains("script-src 'self'"));
    assert!(reply.header("access-control-allow-origin").is_none());
    assert!(!reply.text().contains("<script>") && !reply.text().contains("http://"));
}

#[test]
fn where_a_key_is_asked_for_nothing_is_told_without_it() {
    let dir = Dir::new();
    let token_file = dir.path("farm.token");
    let token_file = token_file.to_str().unwrap();
    let office = office(&dir, &["--http-key", "--token-file", token_file]);
    let key = succeed(terrafarm().args(["token", "--web", "--token-file", token_file]));
    let key = key.trim();
    let token = std::fs::read_to_string(token_file).unwrap();
    assert!(key.len() == 32 && !token.to_lowercase().contains(&key[..8]));
    let get = |path: &str, more: &[(&str, &str)]| http(&office.http, "GET", path, more, b"");
    for path in ["/api/v1/farm", "/api/v1/events", "/metrics", "/page.js", "/nothing"] {
        let reply = get(path, &[]);
        assert_eq!(reply.status, 401, "{path}");
        assert!(reply.json()["error"].as_str().unwrap().contains("terrafarm token --web"));
    }
    let sent_on = get("/", &[]);
    assert_eq!((sent_on.status, sent_on.header("location")), (303, Some("/login")));
    assert!(get("/login", &[]).text().contains("<form"));
    assert_eq!(get("/healthz", &[]).status, 200);
    let bearer = format!("Bearer {key}");
    assert_eq!(get("/metrics", &[("Authorization", &bearer)]).status, 200);
    let since = Instant::now();
    assert_eq!(get("/api/v1/farm", &[("Authorization", "Bearer 00")]).status, 401);
    assert!(since.elapsed() >= Duration::from_secs(1), "a wrong key costs a second");
    let login =
        |key: &str| http(&office.http, "POST", "/login", &[], format!("key={key}").as_bytes());
    assert!(login("00").header("set-cookie").is_none());
    let entered = login(&format!("+{}", key.to_uppercase()));
    let cookie = entered.header("set-cookie").unwrap();
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let cookie = cookie.split(';').next().unwrap();
    assert_eq!(get("/api/v1/farm", &[("Cookie", cookie)]).status, 200);
    // Whoever holds the token needs no key: the link of the farm is another door.
    let mut shots = office.ask(&["shots", "--token-file", token_file]);
    assert!(succeed(&mut shots).contains("no shots"));
}

#[test]
fn a_port_that_was_asked_for_and_is_taken_is_an_error() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let mut second = terrafarm();
    second.args(["coordinator", "--listen", "127.0.0.1:0", "--http", &address]);
    let (_, said) = run(&mut second, 2);
    assert!(said.contains("cannot serve the page"), "{said}");
}

#[test]
fn floods_of_silent_and_slow_connections_keep_nobody_out() {
    let dir = Dir::new();
    let office = office(&dir, &[]);
    // More than may be silent, and more than may be served.
    let silent: Vec<_> = (0..700).map(|_| TcpStream::connect(&office.http).unwrap()).collect();
    let mut slow: Vec<_> = (0..100).map(|_| TcpStream::connect(&office.http).unwrap()).collect();
    for stream in &mut slow {
        // Those that gave way cannot be written to.
        let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: 127.0");
    }
    let since = Instant::now();
    assert_eq!(office.get("/healthz").status, 200);
    assert!(since.elapsed() < Duration::from_secs(2), "answered after {:?}", since.elapsed());
    drop((silent, slow));
    let long = "x".repeat(40 << 10);
    assert_eq!(http(&office.http, "GET", "/", &[("X-Long", &long)], b"").status, 431);
}

#[test]
fn streams_of_events_are_bounded_and_tell_the_part_of_the_lists_that_is_asked_for() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    for name in ["one", "two", "three"] {
        office.submit(&world, &["--name", name]);
    }
    let (events, first) = first_events(&office.http, "shots_limit=1&shots_offset=1");
    let names: Vec<_> = events.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["farm", "shots", "workers"]);
    let shots = &events[1].1;
    assert_eq!(
        (shots["total"].as_u64(), shots["shots"][0]["name"].as_str()),
        (Some(3), Some("two"))
    );
    let more: Vec<_> = (1..64).map(|_| first_events(&office.http, "").1).collect();
    assert_eq!(office.get("/api/v1/events").status, 503);
    drop((first, more));
}

/// A way to a coordinator that loses the first answer to a submission, and its line with it;
/// says how often it has done so.
fn lossy(coordinator: &str) -> (String, Arc<AtomicU32>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (coordinator, losses) = (coordinator.to_owned(), Arc::new(AtomicU32::new(0)));
    let lost = losses.clone();
    std::thread::spawn(move || {
        for near in listener.incoming() {
            let (mut near, mut far) = (near.unwrap(), TcpStream::connect(&coordinator).unwrap());
            let (mut from_far, mut to_near) = (far.try_clone().unwrap(), near.try_clone().unwrap());
            let submitted = Arc::new(AtomicBool::new(false));
            let (seen, lost) = (submitted.clone(), lost.clone());
            std::thread::spawn(move || {
                let mut bytes = [0; 1 << 16];
                while let Ok(count @ 1..) = from_far.read(&mut bytes) {
                    if seen.load(SeqCst) && lost.load(SeqCst) == 0 {
                        lost.store(1, SeqCst);
                        break;
                    }
                    if to_near.write_all(&bytes[..count]).is_err() {
                        break;
                    }
                }
                let _ = to_near.shutdown(Shutdown::Both);
            });
            std::thread::spawn(move || {
                let mut bytes = [0; 1 << 16];
                while let Ok(count @ 1..) = near.read(&mut bytes) {
                    let text = b"idempotency_key";
                    if bytes[..count].windows(text.len()).any(|some| some == text) {
                        submitted.store(true, SeqCst);
                    }
                    if far.write_all(&bytes[..count]).is_err() {
                        break;
                    }
                }
                let _ = far.shutdown(Shutdown::Both);
            });
        }
    });
    (address, losses)
}

#[test]
fn a_submission_whose_answer_is_lost_is_sent_again_and_is_one_shot() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let (address, losses) = lossy(&office.address);
    let mut submit = terrafarm();
    submit.arg("submit").arg(&world.scene).arg("--flight").arg(&world.flight).args(SIZE);
    let (printed, said) = run(submit.args(["--coordinator", &address]), 0);
    assert_eq!((losses.load(SeqCst), printed.trim()), (1, "1"), "{said}");
    assert!(said.contains("was lost") && said.contains("waiting"), "{said}");
    assert_eq!(office.json("/api/v1/shots")["total"], 1);
}

#[test]
fn a_submission_with_a_key_is_one_shot_however_often_it_is_sent() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let first = office.submit(&world, &["--name", "first"]);
    let store = StoreReader::open(&world.dir.path("land.terrain")).unwrap();
    let body = serde_json::to_vec(&tiny(&store, 1)).unwrap();
    let post = |path: &str, key: &str, body: &[u8]| {
        http(&office.http, "POST", path, &[("Idempotency-Key", key)], body)
    };
    let path = "/api/v1/shots";
    for key in ["night-7", "\"night-7\"", "night-7"] {
        let reply = post(path, key, &body);
        assert_eq!((reply.status, reply.json()["shot"].as_u64()), (200, Some(first + 1)));
    }
    let by_address =
        http(&office.http, "POST", &format!("{path}?idempotency_key=night-7"), &[], &body);
    assert_eq!(by_address.json()["shot"], first + 1);
    assert_eq!(post(path, "night-8", &body).json()["shot"], first + 2);
    let other = serde_json::to_vec(&tiny(&store, 2)).unwrap();
    let reused = post(path, "night-7", &other);
    assert_eq!(reused.status, 422, "{}", reused.text());
    assert!(reused.text().contains("is another submission"), "{}", reused.text());
    assert_eq!(post(path, "two words", &other).status, 400);
    assert_eq!(post(&format!("{path}?idempotency_key=a"), "b", &other).status, 400);
    assert_eq!(office.json(path)["total"], 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_comes_when_all_places_at_the_desk_are_taken_waits_for_its_turn() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let mut lines = Vec::new();
    for _ in 0..Config::default().desks_max {
        lines.push(Line::open(&office.address, &Trust::Loopback).await.unwrap());
    }
    let mut submit = office.ask(&["submit"]);
    submit.arg(&world.scene).arg("--flight").arg(&world.flight).args(SIZE);
    let mut waiting = Running::start(&mut submit);
    let said = waiting.expect("waiting, at most");
    assert!(said.contains("as many are served at the desk as there are places"), "{said}");
    assert_eq!(office.json("/api/v1/shots")["total"], 0);
    // One place is enough, although others would be faster.
    lines.pop();
    let (code, said) = waiting.finish();
    assert_eq!((code, said.last().map(String::as_str)), (Some(0), Some("1")), "{said:#?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_10_000_shots_and_1000_workers_the_page_is_there_within_200_ms() {
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let stop = crowd(&office, &world, 10_000, 1000).await;
    office.wait("/api/v1/farm", |farm| farm["workers"]["connected"] == 1000);
    let mut times = Vec::new();
    for _ in 0..5 {
        let since = Instant::now();
        assert_eq!(office.get("/").status, 200);
        for file in ["/page.css", "/page.js", "/chart.js", "/api/v1/farm"] {
            assert_eq!(office.get(file).status, 200);
        }
        let query = "shots_state=active&shots_limit=20&workers_limit=50";
        let (events, _stream) = first_events(&office.http, query);
        times.push(since.elapsed());
        assert!(events[1].1["total"].as_u64().unwrap() >= 10_000, "{}", events[1].1["total"]);
        assert_eq!(events[2].1["total"], 1000);
    }
    times.sort();
    println!("the page and its first events: {times:?}");
    assert!(times[2] < Duration::from_millis(200), "{times:?}");
    stop.cancel();
}
