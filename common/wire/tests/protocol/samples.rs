//! One message of every kind, and strategies for arbitrary ones.

use glam::DVec3;
use proptest::prelude::*;
use terrafarm_common::accuracy::{PixelError, Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::{Region, Split};
use terrafarm_common::shading::{Earth, Haze, Shading, Sky, Sun};
use terrafarm_wire::Message;
use terrafarm_wire::message::*;
use terrafarm_wire::pixels::Pixels;

pub fn camera() -> Camera {
    // Written out, so that the stored bytes do not hang on the flight's trigonometry.
    Camera {
        position: DVec3::new(448_123.25, 5_412_000.5, 1834.125),
        right: DVec3::X,
        up: DVec3::Z,
        forward: DVec3::Y,
        tan_half_hfov: 0.75,
        width: 1920,
        height: 1080,
    }
}

pub fn shading() -> Shading {
    Shading {
        sun: Some(Sun { direction: DVec3::Z, ambient: 0.25, strength: 0.5 }),
        haze: Some(Haze { visibility_m: 4e4, scale_height_m: 0.0, color: [0.5, 0.75, 1.0] }),
        sky: Sky { horizon: [0.5, 0.75, 1.0], zenith: [0.125, 0.25, 0.5] },
        earth: Some(Earth { radius_m: 6.375e6, refraction: 0.125 }),
        below_ground: [0.25; 3],
        bare_ground: None,
    }
}

fn report() -> RenderReport {
    RenderReport {
        cost_us: 12_345,
        rays: 2_073_600,
        steps: 1 << 33,
        fallbacks: 64_282,
        coarser: 700,
        below_ground: true,
    }
}

fn timesheet() -> Timesheet {
    Timesheet {
        idle_us: 300,
        terrain_us: 40_000,
        unpack_us: 5_000,
        render_us: 12_000,
        coreless_us: 345,
        pack_us: 60,
        send_us: 7,
        redo_us: 0,
        other_us: 1,
    }
}

/// Errors of three pixels, two of which see other ground.
fn errors() -> Summary {
    let mut errors = Summary::default();
    for (number, surface_px, depth_m) in
        [(70_000, 0.25, Some(-1.5)), (3, 64.0, None), (9, 0.0, Some(0.0))]
    {
        let mismatch = surface_px > 0.0;
        errors.add(number, &PixelError { surface_px, occlusion_px: 0.0, depth_m, mismatch });
    }
    errors
}

fn pixels() -> Pixels {
    Pixels::raw((0..24u8).collect::<Vec<_>>().into()).unwrap()
}

/// One message of every kind, with both variants where there are two.
pub fn all() -> Vec<(String, Message)> {
    let hash = BlobHash(std::array::from_fn(|i| i as u8));
    let quality = Quality { method: Method::Reference, samples_per_side: 8, tolerance_px: 0.25 };
    let (shot, lease, frame, number) = (ShotId(300), LeaseId(70_000), 17, 5);
    let share = Share::from_millionths(10_000).unwrap();
    let text = || "because: é".to_owned();
    let hello = |role| Hello {
        versions: Versions { oldest: 1, newest: 1 },
        program: "terrafarm 0.1.0".into(),
        name: "büro-7".into(),
        role,
    };
    let messages: Vec<Message> = vec![
        hello(Role::Client).into(),
        hello(Role::Worker { threads: 16, incarnation: u64::MAX, identity: u128::MAX - 1 }).into(),
        Welcome {
            version: 1,
            id: 9,
            coordinator: "tower".into(),
            heartbeat_us: 1_000_000,
            silence_us: 5_000_000,
        }
        .into(),
        Refused { refusal: Refusal::Full, text: text() }.into(),
        Ping { number: 1 }.into(),
        Pong { number: u64::MAX }.into(),
        Goodbye { reason: text() }.into(),
        WantBlobs { hashes: vec![hash, BlobHash([255; 32])], elsewhere: true }.into(),
        Blob { hash, bytes: b"a tile"[..].into() }.into(),
        NoBlob { hash, why: text() }.into(),
        OpenShot {
            shot,
            index: hash,
            shading: shading(),
            quality,
            check: share,
            width: 1920,
            height: 1080,
            live: true,
        }
        .into(),
        Grant {
            lease,
            shot,
            frame,
            region: Region { x: 64, y: 0, width: 32, height: 1080 },
            camera: camera(),
        }
        .into(),
        Revoke { lease }.into(),
        CloseShot { shot }.into(),
        Drain {}.into(),
        Done {
            lease,
            report: report(),
            timesheet: timesheet(),
            check: Some(errors()),
            pixels: pixels(),
        }
        .into(),
        Failed { lease, reason: text() }.into(),
        HandBack { leases: vec![lease, LeaseId(0)] }.into(),
        Submit {
            number,
            name: "alps".into(),
            index: hash,
            shading: shading(),
            quality,
            check: share,
            width: 1920,
            height: 1080,
            split: Split::Tiles(128),
            frames: 600,
            frames_in_flight: 4,
            priority: -3,
            live: true,
        }
        .into(),
        Cameras { number, first: frame, cameras: vec![camera(); 2] }.into(),
        FrameTaken { shot, frame }.into(),
        Cancel { shot }.into(),
        Accepted { number, shot }.into(),
        Rejected { number, reason: text() }.into(),
        Frame {
            shot,
            frame,
            jobs: 60,
            report: report(),
            elapsed_us: 99,
            check: Some(errors()),
            pixels: pixels(),
        }
        .into(),
        FrameFailed { shot, frame, reason: text() }.into(),
        Progress { shot, frames_done: 1, frames_failed: 2, jobs_running: 3, workers: 4 }.into(),
        ShotDone {
            shot,
            frames_done: 598,
            frames_failed: 2,
            jobs: 36_000,
            jobs_repeated: 3,
            elapsed_us: 1,
            report: report(),
            workers: vec![WorkerShare {
                name: text(),
                jobs: 36_000,
                cost_us: 7,
                first_us: 8,
                last_us: 9,
                timesheet: timesheet(),
            }],
        }
        .into(),
        ShotFailed { shot, reason: text() }.into(),
        hello(Role::Desk).into(),
        Request {
            number,
            verb: Verb::Put,
            path: "/api/v1/shots/300/priority".into(),
            range: Some((1 << 20, 4096)),
            body: b"{\"priority\":5}"[..].into(),
        }
        .into(),
        Response {
            number,
            status: 404,
            content_type: "application/json".into(),
            total: 2,
            body: b"{}"[..].into(),
        }
        .into(),
        Speed { pixels_per_s: 31_415_926 }.into(),
        Elsewhere {
            hash,
            workers: vec!["10.0.0.7:4711".parse().unwrap(), "[fe80::7]:4712".parse().unwrap()],
        }
        .into(),
        Sharing { port: 4711 }.into(),
        Ahead { shot, first: frame, stride: 8, cameras: vec![camera(); 2] }.into(),
        hello(Role::Peer).into(),
        Status {
            memory_bytes: 400 << 20,
            memory_limit_bytes: 1 << 30,
            disk_bytes: 3 << 30,
            disk_limit_bytes: 4 << 30,
            damaged: 2,
            given_bytes: 70_000,
            threads_allowed: 15,
        }
        .into(),
    ];
    let mut seen = 0;
    let named = messages.into_iter().map(|message| {
        seen += 1;
        (format!("{seen:02}-{}", kind_name(message.kind()).to_lowercase()), message)
    });
    named.collect()
}

fn rgb() -> impl Strategy<Value = [f32; 3]> {
    [0.0..=1.0f32, 0.0..=1.0f32, 0.0..=1.0f32]
}

pub fn any_camera() -> impl Strategy<Value = Camera> {
    let position = [-1e7..1e7f64, -1e7..1e7f64, -500.0..9e3f64].prop_map(DVec3::from_array);
    let angles = (-720.0..720.0f64, -90.0..=90.0f64, -180.0..=180.0f64, 1.0..=170.0f64);
    (position, angles, 1u32..=16_384, 1u32..=16_384).prop_map(
        |(position, (h, p, r, fov), w, hgt)| Camera::from_angles(position, h, p, r, fov, (w, hgt)),
    )
}

pub fn any_shading() -> impl Strategy<Value = Shading> {
    let sun = (0.0..360.0f64, -90.0..90.0f64, 0.0..=1.0f32, 0.0..=1.0f32).prop_map(
        |(azimuth, elevation, ambient, strength)| Sun::at(azimuth, elevation, ambient, strength),
    );
    let haze =
        (1.0..1e6f64, 0.0..1e4f64, rgb()).prop_map(|(visibility_m, scale_height_m, color)| Haze {
            visibility_m,
            scale_height_m,
            color,
        });
    let earth = (1e5..=1e8f64, -1.0..=0.9f64)
        .prop_map(|(radius_m, refraction)| Earth { radius_m, refraction });
    let sky = (rgb(), rgb()).prop_map(|(horizon, zenith)| Sky { horizon, zenith });
    let options = (prop::option::of(sun), prop::option::of(haze), prop::option::of(earth));
    (options, sky, rgb(), prop::option::of(rgb())).prop_map(
        |((sun, haze, earth), sky, below_ground, bare_ground)| Shading {
            sun,
            haze,
            sky,
            earth,
            below_ground,
            bare_ground,
        },
    )
}

fn any_quality() -> impl Strategy<Value = Quality> {
    (prop::sample::select(&Method::ALL[..]), 1u32..=32, 0.01..=64.0f64).prop_map(
        |(method, samples_per_side, tolerance_px)| Quality {
            method,
            samples_per_side,
            tolerance_px,
        },
    )
}

fn any_hash() -> impl Strategy<Value = BlobHash> {
    any::<[u8; 32]>().prop_map(BlobHash)
}

fn any_pixels() -> impl Strategy<Value = Pixels> {
    (prop::collection::vec(0u8..3, 0..4000), any::<bool>()).prop_map(|(pixels, compress)| {
        let pack = if compress { Pixels::compressed } else { Pixels::raw };
        pack(pixels.into()).unwrap()
    })
}

/// Up to twice as many as are kept.
fn any_errors() -> impl Strategy<Value = Summary> {
    let one = (any::<u32>(), 0.0..=64.0f64, prop::option::of(-1e9..1e9f64), any::<bool>());
    let few = prop::collection::vec(one, 0..50);
    (few, prop::sample::select(vec![1u32, 200])).prop_map(|(few, times)| {
        let mut errors = Summary::default();
        for round in 0..times {
            for &(number, surface_px, depth_m, mismatch) in &few {
                let error = PixelError { surface_px, occlusion_px: 0.0, depth_m, mismatch };
                errors.add(number.wrapping_mul(2 * round + 1), &error);
            }
        }
        errors
    })
}

/// Any message whose fields are more than a few numbers; the others are in [`all`].
pub fn any_message() -> impl Strategy<Value = Message> {
    let open = (any::<u64>(), any_hash(), any_shading(), any_quality(), 1u32..=16_384).prop_map(
        |(shot, index, shading, quality, width)| {
            let shot = ShotId(shot);
            let check = Share::from_millionths(width).unwrap();
            OpenShot {
                shot,
                index,
                shading,
                quality,
                check,
                width,
                height: 7,
                live: width % 2 == 1,
            }
            .into()
        },
    );
    let grant = (any::<[u64; 2]>(), any::<u32>(), any_camera(), any::<[prop::sample::Index; 4]>())
        .prop_map(|([lease, shot], frame, camera, [x, y, width, height])| {
            let x = x.index(camera.width as usize) as u32;
            let y = y.index(camera.height as usize) as u32;
            let width = 1 + width.index((camera.width - x) as usize) as u32;
            let height = 1 + height.index((camera.height - y) as usize) as u32;
            let region = Region { x, y, width, height };
            Grant { lease: LeaseId(lease), shot: ShotId(shot), frame, region, camera }.into()
        });
    let cameras = (any::<u32>(), 0u32..1000, prop::collection::vec(any_camera(), 1..9))
        .prop_map(|(number, first, cameras)| Cameras { number, first, cameras }.into());
    let submit = (any_shading(), any_quality(), ".{0,60}", 1u32..=16_384, 1u32..=1 << 20).prop_map(
        |(shading, quality, name, side, frames)| {
            Submit {
                number: frames,
                name,
                index: BlobHash([3; 32]),
                shading,
                quality,
                check: Share::NONE,
                width: side,
                height: side,
                split: if side % 2 == 0 {
                    Split::Columns
                } else {
                    Split::Tiles(side.min(Split::MAX_TILE_SIDE))
                },
                frames,
                frames_in_flight: 1 + frames % 1024,
                priority: frames as i32 - 1000,
                live: frames % 3 == 0,
            }
            .into()
        },
    );
    let want = (prop::collection::vec(any_hash(), 1..50), any::<bool>())
        .prop_map(|(hashes, elsewhere)| WantBlobs { hashes, elsewhere }.into());
    let ahead = (0u32..1000, 1u32..1000, prop::collection::vec(any_camera(), 1..=64)).prop_map(
        |(first, stride, cameras)| Ahead { shot: ShotId(7), first, stride, cameras }.into(),
    );
    let address = (any::<std::net::IpAddr>(), 1u16..).prop_map(std::net::SocketAddr::from);
    let elsewhere = (any_hash(), prop::collection::vec(address, 1..=4))
        .prop_map(|(hash, workers)| Elsewhere { hash, workers }.into());
    let blob = (any_hash(), prop::collection::vec(any::<u8>(), 0..5000))
        .prop_map(|(hash, bytes)| Blob { hash, bytes: bytes.into() }.into());
    let done = (any::<[u64; 6]>(), any::<bool>(), any_pixels(), prop::option::of(any_errors()))
        .prop_map(
            |([lease, cost_us, rays, steps, fallbacks, coarser], below_ground, pixels, check)| {
                let report =
                    RenderReport { cost_us, rays, steps, fallbacks, coarser, below_ground };
                let timesheet = Timesheet { idle_us: cost_us, redo_us: steps, ..timesheet() };
                Done { lease: LeaseId(lease), report, timesheet, check, pixels }.into()
            },
        );
    let failed = (any::<u64>(), ".{0,300}")
        .prop_map(|(lease, reason)| Failed { lease: LeaseId(lease), reason }.into());
    let hand_back = prop::collection::vec(any::<u64>().prop_map(LeaseId), 0..50)
        .prop_map(|leases| HandBack { leases }.into());
    let sample = prop::sample::select(all()).prop_map(|(_, message)| message);
    prop_oneof![
        open, grant, cameras, submit, want, blob, done, failed, hand_back, ahead, elsewhere, sample
    ]
}
