//! The page in a headless Chromium: what it shows, and what its buttons do.

use crate::office::{Office, office};
use crate::support::{PATIENCE, World, worker};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

/// A browser, and one tab of it, told what to do by its debugging protocol over a pipe.
struct Browser {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    last: u64,
    tab: String,
    /// What the page complained of: scripts that failed, content that was refused.
    complaints: Vec<String>,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Starts one with a tab of this size; `None` where there is none.
    fn start(width: u32, height: u32) -> Option<Self> {
        let program = ["chromium", "chromium-browser", "google-chrome"].into_iter().find(|name| {
            let asked = Command::new(name).arg("--version").stdout(Stdio::null()).status();
            asked.is_ok_and(|status| status.success())
        });
        let Some(program) = program else {
            assert!(
                std::env::var_os("TERRAFARM_REQUIRE_ORACLES").is_none(),
                "there is no Chromium, and TERRAFARM_REQUIRE_ORACLES is set"
            );
            println!("skipped: there is no Chromium");
            return None;
        };
        let profile = tempfile::tempdir().unwrap();
        // The pipe of the protocol is descriptors 3 and 4.
        let script = "exec \"$0\" --headless --no-sandbox --disable-gpu --no-first-run \
                      --user-data-dir=\"$1\" --remote-debugging-pipe \
                      3<&0 4>&1 </dev/null >/dev/null 2>/dev/null";
        let mut child = Command::new("sh")
            .args(["-c", script, program])
            .arg(profile.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let to = child.stdin.take().unwrap();
        let from = BufReader::new(child.stdout.take().unwrap());
        let (tab, complaints) = (String::new(), Vec::new());
        let mut browser = Browser { child, to, from, last: 0, tab, complaints, _profile: profile };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let target = json!({"targetId": target["targetId"], "flatten": true});
        let session = browser.call("Target.attachToTarget", target);
        browser.tab = session["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Runtime.enable", "Log.enable", "Page.enable"] {
            browser.call(domain, json!({}));
        }
        let size =
            json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        browser.call("Emulation.setDeviceMetricsOverride", size);
        Some(browser)
    }

    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.last += 1;
        let mut message = json!({"id": self.last, "method": method, "params": parameters});
        if !self.tab.is_empty() {
            message["sessionId"] = self.tab.as_str().into();
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        loop {
            let mut bytes = Vec::new();
            self.from.read_until(0, &mut bytes).unwrap();
            assert_eq!(bytes.pop(), Some(0), "the browser ended");
            let message: Value = serde_json::from_slice(&bytes).unwrap();
            if message["id"] == self.last {
                assert!(message["error"].is_null(), "{method}: {message}");
                return message["result"].clone();
            }
            let complaint = match message["method"].as_str() {
                Some("Runtime.exceptionThrown") => true,
                Some("Log.entryAdded") => message["params"]["entry"]["level"] == "error",
                _ => false,
            };
            if complaint {
                self.complaints.push(message["params"].to_string());
            }
        }
    }

    fn open(&mut self, url: &str) {
        self.call("Page.navigate", json!({ "url": url }));
    }

    /// What an expression gives on the page.
    fn ask(&mut self, expression: &str) -> Value {
        let asked = json!({"expression": expression, "returnByValue": true});
        let mut answer = self.call("Runtime.evaluate", asked);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].take()
    }

    /// Waits until an expression is true; while what it asks about is not there, it is not.
    fn expect(&mut self, expression: &str) {
        let deadline = Instant::now() + PATIENCE;
        let asked = format!(
            "(() => {{ try {{ return Boolean({expression}); }} catch {{ return false; }} }})()"
        );
        while self.ask(&asked) != true {
            if Instant::now() > deadline {
                let text = self.ask("document.body.innerText");
                panic!("{expression} does not come true on\n{text}\n{:#?}", self.complaints);
            }
            std::thread::yield_now();
        }
    }

    /// Clicks with the mouse in the middle of an element. Before the page is painted its style
    /// sheet may still be on the way, and the element moves once that is there.
    fn click(&mut self, element: &str) {
        self.expect("performance.getEntriesByName('first-contentful-paint').length");
        let place = self.ask(&format!(
            "(() => {{ const e = {element}; e.scrollIntoView({{block: 'center'}}); \
             const r = e.getBoundingClientRect(); \
             return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        ));
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({
                "type": kind, "x": place[0], "y": place[1], "button": "left", "clickCount": 1,
            });
            self.call("Input.dispatchMouseEvent", event);
        }
    }

    fn key(&mut self, key: &str, code: u32, text: &str) {
        for kind in ["keyDown", "keyUp"] {
            let event = json!({
                "type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code,
                "text": if kind == "keyDown" { text } else { "" },
            });
            self.call("Input.dispatchKeyEvent", event);
        }
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A name that would run if the page took it for markup.
const HOSTILE: &str = "<img src=x onerror=document.title='hacked'>";

fn url(office: &Office) -> String {
    format!("http://{}/", office.http)
}

#[test]
fn the_page_shows_a_farm_at_work_and_takes_names_for_what_they_are() {
    let Some(mut browser) = Browser::start(1280, 900) else { return };
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    browser.open(&url(&office));
    browser.expect("document.querySelector('#link.live')");
    browser.expect("document.querySelector('#shots-empty').innerText.includes('terrafarm submit')");
    let shot = office.submit(&world, &["--name", HOSTILE]);
    let _worker = worker(&office.address, "<b>bold</b>");
    browser.expect("document.querySelector('.worker .name').textContent === '<b>bold</b>'");
    office.wait(&format!("/api/v1/shots/{shot}"), |shot| shot["state"] == "done");
    browser.click("document.querySelector('button[data-state=over]')");
    browser.expect("document.querySelector('.shot .state')?.textContent === 'done'");
    let name = browser.ask("document.querySelector('.shot .name').textContent");
    assert_eq!(name, HOSTILE);
    browser
        .expect("document.querySelector('.shot .facts').textContent.startsWith('9 of 9 frames')");
    browser.expect("document.querySelector('.shot img').naturalWidth === 192");
    assert_eq!(browser.ask("document.title"), "terrafarm");
    assert_eq!(browser.ask("document.querySelectorAll('[onerror], b').length"), 0);
    // The chart has its first sample after five seconds.
    browser.expect("document.querySelector('#chart .curve')");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn buttons_pause_resume_urge_and_cancel_and_a_frame_says_why_it_is_not_done() {
    let Some(mut browser) = Browser::start(1280, 900) else { return };
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    let path = format!("/api/v1/shots/{}", office.submit(&world, &["--name", "orders"]));
    browser.open(&url(&office));
    browser.expect("document.querySelector('.shot .name')?.textContent === 'orders'");
    let button = |text: &str| {
        format!(
            "[...document.querySelectorAll('.shot button')].find(b => b.textContent === '{text}')"
        )
    };
    browser.click(&button("pause"));
    browser.expect("document.querySelector('.shot .state').textContent === 'paused'");
    assert_eq!(office.json(&path)["state"], "paused");
    browser.expect("document.querySelector('#said').textContent !== ''");
    browser.click(&button("+"));
    office.wait(&path, |shot| shot["priority"] == 1);
    browser.expect("document.querySelector('.shot .facts').textContent.includes('priority 1')");
    browser.click(&button("resume"));
    office.wait(&path, |shot| shot["state"] != "paused");
    // By the keyboard alone: open the details, ask about frame 4.
    browser.ask("document.querySelector('.shot summary').focus()");
    browser.key("Enter", 13, "\r");
    browser.expect("document.querySelector('.shot details').open");
    browser.key("Tab", 9, "");
    browser.key("4", 52, "4");
    browser.key("Enter", 13, "\r");
    browser.expect("document.querySelector('.shot output').textContent.startsWith('frame 4: ')");
    // One click asks, the second one does it.
    browser.click(&button("cancel"));
    browser.expect(&button("really?"));
    assert_ne!(office.json(&path)["state"], "canceled");
    browser.click(&button("really?"));
    office.wait(&path, |shot| shot["state"] == "canceled");
    browser.expect("document.querySelectorAll('.shot').length === 0");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn on_a_phone_nothing_is_wider_than_the_screen() {
    let Some(mut browser) = Browser::start(360, 740) else { return };
    let world = World::new(300);
    let office = office(&world.dir, &[]);
    office.submit(&world, &["--name", &"a long name without an end ".repeat(9)]);
    office.submit(&world, &["--name", &"x".repeat(250)]);
    let _worker = worker(&office.address, &"worker".repeat(40));
    browser.open(&url(&office));
    browser.expect("document.querySelectorAll('.worker .name').length === 1");
    browser.expect("document.querySelectorAll('#shots-empty').length === 1");
    browser.click("document.querySelectorAll('button[data-list=shots]')[2]");
    browser.expect("document.querySelectorAll('.shot').length === 2");
    assert!(browser.ask("document.documentElement.scrollWidth").as_u64().unwrap() <= 360);
    let small = "[...document.querySelectorAll('.shot .orders button, .tabs button')]\
                 .filter(b => b.offsetParent && b.getBoundingClientRect().height < 40).length";
    assert_eq!(browser.ask(small), 0, "buttons for fingers");
}

#[test]
fn where_a_key_is_asked_for_the_browser_enters_it_once() {
    let Some(mut browser) = Browser::start(1280, 900) else { return };
    let dir = crate::support::Dir::new();
    let token_file = dir.path("farm.token");
    let token_file = token_file.to_str().unwrap();
    let office = office(&dir, &["--http-key", "--token-file", token_file]);
    let mut token = crate::support::terrafarm();
    token.args(["token", "--web", "--token-file", token_file]);
    let key = crate::support::succeed(&mut token);
    browser.open(&url(&office));
    browser.expect("location.pathname === '/login' && document.querySelector('#key')");
    browser.ask(&format!("document.querySelector('#key').value = '{}'", key.trim()));
    browser.click("document.querySelector('button')");
    browser.expect("document.querySelector('#link.live')");
    assert_eq!(browser.ask("document.cookie"), "", "no script reads it");
}
