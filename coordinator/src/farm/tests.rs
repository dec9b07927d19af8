#![allow(clippy::unwrap_used)]

mod seen;

use super::*;
use crate::blobs::Order;
use bytes::Bytes;
use glam::DVec3;
use terrafarm_common::accuracy::{PixelError, Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::BlobHash;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::encode;
use terrafarm_wire::limits::{NEWEST_VERSION, WANT_BLOBS_MAX};
use terrafarm_wire::message::{
    Blob, Cameras, Done, Failed, HandBack, RenderReport, Submit, Timesheet, WantBlobs,
};
use terrafarm_wire::pixels::Pixels;

const SIZE: (u32, u32) = (64, 16);
const CLIENT: ClientId = ClientId(100);

/// A farm, the time, and what it said since it was last asked.
struct Bench {
    farm: Farm,
    now: Micros,
}

/// The number of a worker's PC.
fn identity_of(peer: Peer) -> u128 {
    match peer {
        Peer::Worker(worker) => u128::from(worker.0) + 1,
        Peer::Client(_) => 0,
    }
}

impl Bench {
    fn new() -> Self {
        Bench::auditing(Share::NONE)
    }

    fn auditing(audit: Share) -> Self {
        let config = terrafarm_sched::Config { audit, ..Default::default() };
        Bench { farm: Farm::new(config, 1, 1 << 20), now: Micros(0) }
    }

    fn event(&mut self, peer: Peer, event: PeerEvent) -> Vec<Out> {
        self.now = self.now.after(1000);
        self.farm.handle(self.now, peer, event);
        std::iter::from_fn(|| self.farm.poll_out()).collect()
    }

    fn say(&mut self, peer: Peer, message: impl Into<Message>) -> Vec<Out> {
        self.event(peer, PeerEvent::Said(message.into()))
    }

    fn join(&mut self, peer: Peer, threads: u32) -> Vec<Out> {
        self.event(
            peer,
            PeerEvent::Joined(Greeting {
                name: format!("{peer:?}"),
                threads,
                identity: identity_of(peer),
                address: Some([127, 0, 0, 1].into()),
            }),
        )
    }

    fn gone(&mut self, peer: Peer) -> Vec<Out> {
        self.event(peer, PeerEvent::Gone(LostReason::Broken, "cut".into()))
    }

    /// A client with a shot of so many frames.
    fn submit(&mut self, frames: u32) -> Vec<Out> {
        self.join(Peer::Client(CLIENT), 0);
        self.say(Peer::Client(CLIENT), submission(frames));
        let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, SIZE);
        let cameras = vec![camera; frames as usize];
        self.say(Peer::Client(CLIENT), Cameras { number: 1, first: 0, cameras })
    }
}

fn submission(frames: u32) -> Submit {
    Submit {
        number: 1,
        name: "test".into(),
        index: BlobHash([1; 32]),
        shading: shading(),
        quality: Quality::default(),
        check: Share::NONE,
        width: SIZE.0,
        height: SIZE.1,
        split: Split::Columns,
        frames,
        frames_in_flight: 2,
        priority: 0,
        live: false,
    }
}

fn shading() -> Shading {
    Shading::default()
}

fn worker(number: u64) -> Peer {
    Peer::Worker(WorkerId(number))
}

fn grants(out: &[Out]) -> Vec<(WorkerId, Grant)> {
    let grant = |out: &Out| match out {
        Out::Send(Peer::Worker(worker), Message::Grant(grant)) => Some((*worker, *grant)),
        _ => None,
    };
    out.iter().filter_map(grant).collect()
}

fn done(grant: &Grant) -> Done {
    let pixels = vec![grant.lease.0 as u8; grant.region.area() as usize * 3];
    let report =
        RenderReport { cost_us: 500, rays: 1, steps: 1, fallbacks: 3, ..RenderReport::default() };
    let mut errors = Summary::default();
    let error = PixelError {
        surface_px: f64::from(grant.region.x),
        occlusion_px: 0.0,
        depth_m: None,
        mismatch: true,
    };
    errors.add(grant.region.x, &error);
    let pixels = Pixels::raw(Bytes::from(pixels)).unwrap();
    let timesheet = Timesheet { render_us: 1000, idle_us: 10, ..Timesheet::default() };
    Done { lease: grant.lease, report, timesheet, check: Some(errors), pixels }
}

/// Answers every grant until none is left; returns the frames that came out.
fn render_all(bench: &mut Bench, mut out: Vec<Out>) -> Vec<(u32, Rgb8)> {
    let mut frames = Vec::new();
    while !out.is_empty() {
        let mut next = Vec::new();
        for (worker, grant) in grants(&out) {
            next.extend(bench.say(Peer::Worker(worker), done(&grant)));
        }
        for one in out {
            if let Out::SendFrame(_, head, picture) = one {
                let frame = head.with(Pixels::raw(Bytes::new()).unwrap());
                let errors = frame.check.unwrap();
                assert_eq!(errors.samples(), u64::from(frame.jobs), "one error a job");
                let fallbacks = frame.report.fallbacks;
                assert_eq!(fallbacks, 3 * u64::from(frame.jobs), "three fallbacks a job");
                next.extend(bench.say(
                    Peer::Client(CLIENT),
                    terrafarm_wire::message::FrameTaken { shot: frame.shot, frame: frame.frame },
                ));
                frames.push((frame.frame, picture));
            }
        }
        out = next;
    }
    frames
}

#[test]
fn a_shot_travels_from_its_submission_to_its_last_frame() {
    let mut bench = Bench::new();
    bench.join(worker(1), 2);
    let out = bench.submit(5);
    assert!(matches!(&out[0], Out::Send(Peer::Client(CLIENT), Message::Accepted(_))));
    let opened = out.iter().position(|o| matches!(o, Out::Send(_, Message::OpenShot(_)))).unwrap();
    let granted = out.iter().position(|o| matches!(o, Out::Send(_, Message::Grant(_)))).unwrap();
    assert!(opened < granted, "a worker knows the shot before its first job");
    let frames = render_all(&mut bench, out);
    assert_eq!(frames.len(), 5);
    for (_, picture) in &frames {
        assert!(picture.pixels().iter().all(|&byte| byte != 0), "every pixel came from a job");
    }
}

#[test]
fn cameras_that_come_once_more_are_refused_and_the_shot_goes_on() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.submit(3);
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, SIZE);
    let again = Cameras { number: 1, first: 0, cameras: vec![camera; 3] };
    let refused = bench.say(Peer::Client(CLIENT), again);
    let is_refusal = |out: &Out| matches!(out, Out::Send(_, Message::Rejected(_)));
    assert!(refused.iter().any(is_refusal), "{refused:?}");
    assert_eq!(render_all(&mut bench, out).len(), 3);
    let other = Peer::Client(ClientId(101));
    bench.join(other, 0);
    bench.say(other, submission(1));
    let out = bench.say(other, Cameras { number: 1, first: 0, cameras: vec![camera] });
    assert!(!grants(&out).is_empty(), "the worker is free for the next");
}

#[test]
fn a_client_is_asked_for_no_more_blobs_at_once_than_a_message_holds() {
    let mut bench = Bench::new();
    bench.join(Peer::Client(CLIENT), 0);
    let hash = |n: usize| hash_of(&n.to_le_bytes());
    let asks = (0..WANT_BLOBS_MAX + 476).map(|n| Order::Ask(CLIENT, hash(n)));
    bench.farm.carry_out(asks.collect());
    let mut asked = Vec::new();
    while let Some(out) = bench.farm.poll_out() {
        let Out::Send(Peer::Client(CLIENT), message) = out else { panic!("{out:?}") };
        encode(NEWEST_VERSION, &message).unwrap();
        let Message::WantBlobs(want) = message else { panic!("{message:?}") };
        asked.extend(want.hashes);
    }
    assert_eq!(asked, (0..WANT_BLOBS_MAX + 476).map(hash).collect::<Vec<_>>());
}

#[test]
fn what_a_lost_worker_held_is_rendered_by_another_and_its_late_result_is_refused() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.submit(1);
    let held = grants(&out)[0].1;
    bench.gone(worker(1));
    let late = bench.say(worker(1), done(&held));
    assert!(late.is_empty(), "{late:?}");
    let out = bench.join(worker(2), 1);
    assert!(grants(&out).iter().all(|(_, grant)| grant.lease > held.lease));
    assert_eq!(render_all(&mut bench, out).len(), 1);
}

#[test]
fn a_worker_whose_long_message_comes_slowly_is_not_dropped_from_a_live_shot() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    bench.join(worker(2), 1);
    bench.join(Peer::Client(CLIENT), 0);
    bench.say(Peer::Client(CLIENT), Submit { live: true, ..submission(1) });
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, SIZE);
    bench.say(Peer::Client(CLIENT), Cameras { number: 1, first: 0, cameras: vec![camera] });
    let mut closed = Vec::new();
    for _ in 0..25 {
        bench.now = bench.now.after(39_000);
        for one in bench.event(worker(1), PeerEvent::Stirred) {
            if let Out::Close(peer, why) = one {
                closed.push((peer, why));
            }
        }
    }
    assert_eq!(closed.len(), 1, "{closed:?}");
    assert_eq!(closed[0].0, worker(2), "it said nothing");
}

#[test]
fn pixels_of_the_wrong_number_fail_the_job_and_not_the_farm() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.submit(1);
    let grant = grants(&out)[0].1;
    let short = Done { pixels: Pixels::raw(Bytes::from(vec![0; 3])).unwrap(), ..done(&grant) };
    let mut out: Vec<_> = out
        .into_iter()
        .filter(|o| !matches!(o, Out::Send(_, Message::Grant(g)) if g.lease == grant.lease))
        .collect();
    out.extend(bench.say(worker(1), short));
    out.extend(bench.join(worker(2), 1));
    assert_eq!(render_all(&mut bench, out).len(), 1);
}

#[test]
fn a_job_that_fails_three_times_fails_its_frame_with_the_reason() {
    let mut bench = Bench::new();
    let mut out = bench.submit(1);
    let mut failures = 0;
    for number in 1..=3 {
        out.extend(bench.join(worker(number), 1));
    }
    let mut said = String::new();
    while !out.is_empty() {
        let mut next = Vec::new();
        for (worker, grant) in grants(&out) {
            failures += 1;
            let failed = Failed { lease: grant.lease, reason: "no such tile".into() };
            next.extend(bench.say(Peer::Worker(worker), failed));
        }
        for one in &out {
            if let Out::Send(Peer::Client(_), Message::FrameFailed(failed)) = one {
                said = failed.reason.clone();
            }
            if let Out::Send(Peer::Client(_), Message::ShotFailed(failed)) = one {
                said = failed.reason.clone();
            }
        }
        out = next;
    }
    assert!(failures >= 3, "{failures}");
    assert!(said.contains("no such tile"), "{said:?}");
}

#[test]
fn when_the_client_goes_away_its_jobs_are_taken_back() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.submit(3);
    let held = grants(&out).len();
    assert!(held > 0);
    let out = bench.gone(Peer::Client(CLIENT));
    let revoked = out.iter().filter(|o| matches!(o, Out::Send(_, Message::Revoke(_)))).count();
    assert_eq!(revoked, held);
    assert!(out.iter().any(|o| matches!(o, Out::Send(_, Message::CloseShot(_)))));
}

#[test]
fn a_leaving_worker_hands_back_and_gets_no_more() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.submit(3);
    let leases = grants(&out).iter().map(|(_, grant)| grant.lease).collect();
    let out = bench.say(worker(1), HandBack { leases });
    assert!(grants(&out).is_empty());
    let out = bench.join(worker(2), 1);
    assert_eq!(render_all(&mut bench, out).len(), 3);
}

#[test]
fn terrain_goes_from_the_client_to_every_worker_that_wants_it() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    bench.join(worker(2), 1);
    bench.submit(4);
    let bytes = Bytes::from_static(b"tile");
    let hash = hash_of(&bytes);
    let want = || WantBlobs { hashes: vec![hash], elsewhere: true };
    let out = bench.say(worker(1), want());
    assert!(matches!(&out[..], [Out::Send(Peer::Client(CLIENT), Message::WantBlobs(_))]));
    assert!(bench.say(worker(2), want()).is_empty(), "asked already");
    let out = bench.say(Peer::Client(CLIENT), Blob { hash, bytes });
    assert_eq!(out.len(), 2);
    let wrong = BlobHash([9; 32]);
    bench.say(worker(1), WantBlobs { hashes: vec![wrong], elsewhere: true });
    let out =
        bench.say(Peer::Client(CLIENT), Blob { hash: wrong, bytes: Bytes::from_static(b"x") });
    assert!(matches!(&out[..], [Out::Send(Peer::Worker(_), Message::NoBlob(_))]), "{out:?}");
}

#[test]
fn a_peer_that_sends_what_is_not_its_to_send_is_closed() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    let out = bench.say(worker(1), terrafarm_wire::message::Cancel { shot: ShotId(1) });
    assert!(out.iter().any(|o| matches!(o, Out::Close(peer, _) if *peer == worker(1))), "{out:?}");
    let out = bench.submit(1);
    assert!(grants(&out).is_empty(), "it gets no work");
}

#[test]
fn a_shot_that_needs_too_much_memory_is_rejected_with_advice() {
    let mut bench = Bench::new();
    bench.submit(1);
    let submit = Submit {
        number: 2,
        name: "vast".into(),
        index: BlobHash([1; 32]),
        shading: shading(),
        quality: Quality::default(),
        check: Share::NONE,
        width: 16_384,
        height: 16_384,
        split: Split::Columns,
        frames: 1000,
        frames_in_flight: 1000,
        priority: 0,
        live: false,
    };
    let out = bench.say(Peer::Client(CLIENT), submit);
    let [Out::Send(_, Message::Rejected(rejected))] = &out[..] else { panic!("{out:?}") };
    assert!(rejected.reason.contains("--frames-in-flight"), "{}", rejected.reason);
}

#[test]
fn cameras_that_do_not_fit_reject_the_shot() {
    let mut bench = Bench::new();
    bench.join(worker(1), 1);
    bench.submit(1);
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, (8, 8));
    let out =
        bench.say(Peer::Client(CLIENT), Cameras { number: 7, first: 0, cameras: vec![camera] });
    assert!(matches!(&out[..], [Out::Send(_, Message::Rejected(_))]), "{out:?}");
}

/// What everyone but a liar renders: a number for each place.
fn right(grant: &Grant) -> Vec<u8> {
    let value = (grant.frame * 7 + grant.region.x) as u8 | 1;
    vec![value; grant.region.area() as usize * 3]
}

/// Answers every grant, a liar's with other pixels; the frames that came out, each with
/// whether all of it is right.
fn render_with_liar(bench: &mut Bench, mut out: Vec<Out>, liar: WorkerId) -> Vec<(u32, bool)> {
    let mut frames = Vec::new();
    while !out.is_empty() {
        let mut next = Vec::new();
        for (worker, grant) in grants(&out) {
            let mut pixels = right(&grant);
            if worker == liar {
                pixels.fill(0);
            }
            let pixels = Pixels::raw(Bytes::from(pixels)).unwrap();
            next.extend(bench.say(Peer::Worker(worker), Done { pixels, ..done(&grant) }));
        }
        for one in out {
            if let Out::SendFrame(_, head, picture) = one {
                let frame = head.with(Pixels::raw(Bytes::new()).unwrap());
                let (shot, frame) = (frame.shot, frame.frame);
                let taken = terrafarm_wire::message::FrameTaken { shot, frame };
                next.extend(bench.say(Peer::Client(CLIENT), taken));
                frames.push((frame, picture.pixels().iter().all(|&byte| byte != 0)));
            }
        }
        out = next;
    }
    frames
}

#[test]
fn a_liar_is_found_out_by_audits_and_what_comes_later_is_right() {
    let audit = "20%".parse().unwrap();
    let mut bench = Bench::auditing(audit);
    let liar = WorkerId(2);
    (1..=4).for_each(|number| _ = bench.join(worker(number), 1));
    let out = bench.submit(40);
    let frames = render_with_liar(&mut bench, out, liar);
    assert_eq!(frames.len(), 40);
    let last_wrong = frames.iter().rposition(|(_, is_right)| !is_right);
    assert!(last_wrong.is_none_or(|last| last < 30), "{frames:?}");
    assert!(bench.farm.scheduler.is_distrusted(liar));
    assert!(bench.farm.scheduler.account().audited > 0);
    // It comes back under another name from another address, and is known; another PC that is
    // called as it is none.
    bench.gone(worker(2));
    for (number, name, identity, is_known) in [
        (9, "renamed", identity_of(worker(2)), true),
        (10, &*format!("{:?}", worker(2)), identity_of(worker(10)), false),
    ] {
        let address = Some([10, 0, 0, 9].into());
        let back = Greeting { name: name.to_owned(), threads: 1, identity, address };
        bench.event(worker(number), PeerEvent::Joined(back));
        assert_eq!(bench.farm.scheduler.is_distrusted(WorkerId(number)), is_known, "{name}");
    }
    // Once it is cleared it stays so.
    bench.farm.trust_again(WorkerId(9));
    let address = None;
    let (name, identity) = ("again".to_owned(), identity_of(worker(2)));
    let back = Greeting { name, threads: 1, identity, address };
    bench.event(worker(11), PeerEvent::Joined(back));
    assert!(!bench.farm.scheduler.is_distrusted(WorkerId(11)));
}

#[test]
fn where_all_render_the_same_audits_change_nothing() {
    let mut bench = Bench::auditing("100%".parse().unwrap());
    (1..=3).for_each(|number| _ = bench.join(worker(number), 1));
    let out = bench.submit(6);
    let frames = render_with_liar(&mut bench, out, WorkerId(99));
    assert!(frames.len() == 6 && frames.iter().all(|(_, is_right)| *is_right));
    let account = bench.farm.scheduler.account();
    assert!(account.audited > account.accepted / 2, "{account:?}");
    assert!(bench.farm.shots.iter().next().is_none(), "the shot is over");
}

#[test]
fn workers_are_told_where_the_camera_will_be_now_and_then() {
    let mut bench = Bench::new();
    bench.submit(600);
    let mut told = Vec::new();
    let mut out = bench.join(worker(1), 4);
    while !out.is_empty() {
        let mut next = Vec::new();
        for one in &out {
            match one {
                Out::Send(_, Message::Ahead(ahead)) => told.push(ahead.clone()),
                Out::SendFrame(_, head, _) => {
                    let frame = head.clone().with(Pixels::raw(Bytes::new()).unwrap());
                    let taken = terrafarm_wire::message::FrameTaken {
                        shot: frame.shot,
                        frame: frame.frame,
                    };
                    next.extend(bench.say(Peer::Client(CLIENT), taken));
                }
                _ => {}
            }
        }
        for (worker, grant) in grants(&out) {
            let told_until = told
                .last()
                .map_or(0, |ahead| ahead.first + ahead.stride * ahead.cameras.len() as u32);
            assert!(grant.frame < told_until.max(1) || told_until >= 592, "{}", grant.frame);
            next.extend(bench.say(Peer::Worker(worker), done(&grant)));
        }
        out = next;
    }
    assert!((4..=6).contains(&told.len()), "told {} times", told.len());
    assert_eq!((told[0].first, told[0].stride, told[0].cameras.len()), (8, 8, 32));
    assert!(told.iter().all(|ahead| ahead.first + 8 * (ahead.cameras.len() as u32 - 1) < 600));
}

/// Blobs that a worker is sent, and where it is sent for others.
fn terrain(out: &[Out], to: Peer) -> (usize, Vec<std::net::SocketAddr>) {
    let messages = out.iter().filter_map(|out| match out {
        Out::Send(peer, message) if *peer == to => Some(message),
        _ => None,
    });
    let (mut blobs, mut elsewhere) = (0, Vec::new());
    for message in messages {
        match message {
            Message::Blob(_) => blobs += 1,
            Message::Elsewhere(message) => elsewhere.extend(&message.workers),
            _ => {}
        }
    }
    (blobs, elsewhere)
}

#[test]
fn workers_are_sent_to_each_other_when_more_terrain_waits_than_may() {
    let mut bench = Bench::new();
    bench.submit(9);
    bench.farm.redirect_above(1000);
    (1..=3).for_each(|number| drop(bench.join(worker(number), 1)));
    let (bytes, hash) = (Bytes::from_static(b"a tile"), hash_of(b"a tile"));
    let want = |elsewhere| WantBlobs { hashes: vec![hash], elsewhere };
    bench.say(worker(1), want(true));
    bench.say(Peer::Client(CLIENT), Blob { hash, bytes });
    bench.say(worker(1), terrafarm_wire::message::Sharing { port: 4711 });
    let out = bench.say(worker(2), want(true));
    assert_eq!(terrain(&out, worker(2)), (1, vec![]), "the links are free");
    bench.farm.set_unsent(1000);
    let out = bench.say(worker(3), want(true));
    assert_eq!(terrain(&out, worker(3)), (0, vec!["127.0.0.1:4711".parse().unwrap()]));
    let out = bench.say(worker(3), want(false));
    assert_eq!(terrain(&out, worker(3)), (1, vec![]), "it insists");
    let out = bench.say(worker(1), want(true));
    assert_eq!(terrain(&out, worker(1)), (1, vec![]), "nobody is sent to itself");
    bench.gone(worker(1));
    let out = bench.say(worker(2), want(true));
    assert_eq!(terrain(&out, worker(2)), (1, vec![]), "who has it is gone");
}

#[test]
fn workers_of_other_pcs_are_not_sent_to_a_port_of_this_one() {
    let mut bench = Bench::new();
    bench.submit(9);
    bench.farm.redirect_above(0);
    bench.join(worker(1), 1);
    let address = Some([10, 0, 0, 7].into());
    bench.event(
        worker(2),
        PeerEvent::Joined(Greeting { name: "far".into(), threads: 1, identity: 0, address }),
    );
    let (bytes, hash) = (Bytes::from_static(b"a tile"), hash_of(b"a tile"));
    let want = WantBlobs { hashes: vec![hash], elsewhere: true };
    for number in [1, 2] {
        bench.say(worker(number), terrafarm_wire::message::Sharing { port: 4711 });
    }
    bench.say(worker(1), want.clone());
    bench.say(Peer::Client(CLIENT), Blob { hash, bytes });
    let out = bench.say(worker(2), want.clone());
    assert_eq!(terrain(&out, worker(2)), (1, vec![]));
    let out = bench.say(worker(1), want);
    assert_eq!(terrain(&out, worker(1)), (0, vec!["10.0.0.7:4711".parse().unwrap()]));
}
