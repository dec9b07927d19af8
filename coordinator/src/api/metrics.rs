//! `/metrics` in the text format of Prometheus, and `/healthz`.

use super::Desk;
use super::workers::WorkerCounts;
use crate::view::ShotState;
use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde_json::json;
use std::fmt::Write;
use std::sync::Arc;

/// The text.
#[derive(Default)]
struct Exposition(String);

impl Exposition {
    fn family(&mut self, name: &str, kind: &str, help: &str) {
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    fn one(&mut self, name: &str, kind: &str, help: &str, value: f64) {
        self.family(name, kind, help);
        let _ = writeln!(self.0, "{name} {value}");
    }

    /// Label values are names of states: nothing in them needs escaping.
    fn labelled(&mut self, name: &str, label: &str, of: &str, value: usize) {
        let _ = writeln!(self.0, "{name}{{{label}=\"{of}\"}} {value}");
    }
}

/// `GET /metrics`
pub(super) async fn metrics(State(desk): State<Arc<Desk>>) -> Response {
    let board = desk.board();
    let farm = &board.farm;
    let mut text = Exposition::default();
    let workers = WorkerCounts::of(&board);
    text.family("terrafarm_workers", "gauge", "Workers that are connected, by what they do.");
    let counts = [("idle", workers.idle), ("busy", workers.busy), ("draining", workers.draining)];
    for (state, count) in counts {
        text.labelled("terrafarm_workers", "state", state, count);
    }
    text.family("terrafarm_shots", "gauge", "Shots, by state.");
    for state in ShotState::ALL {
        let count = board.states.get(&state).copied().unwrap_or(0);
        text.labelled("terrafarm_shots", "state", state.name(), count);
    }
    let waiting = board.shots.iter().filter(|shot| !shot.state.is_over());
    let frames = waiting
        .map(|shot| u64::from(shot.frames.saturating_sub(shot.frames_done + shot.frames_failed)));
    let gauges = [
        ("terrafarm_threads", "Render threads of all workers.", workers.threads as f64),
        (
            "terrafarm_threads_allowed",
            "Render threads that may be used now: workers make room for others on their PC.",
            workers.threads_allowed as f64,
        ),
        ("terrafarm_jobs_running", "Jobs that workers hold.", farm.jobs_running as f64),
        (
            "terrafarm_frames_waiting",
            "Frames that are still to be done.",
            frames.sum::<u64>() as f64,
        ),
        (
            "terrafarm_efficiency_ratio",
            "Share of the workers' time that went into rendering that was used, last 5 s.",
            farm.history.last().map_or(0.0, |sample| sample.efficiency),
        ),
        (
            "terrafarm_uptime_seconds",
            "Time since the coordinator started.",
            farm.at_ms as f64 / 1e3,
        ),
    ];
    for (name, help, value) in gauges {
        text.one(name, "gauge", help, value);
    }
    let counters = [
        ("terrafarm_frames_total", "Frames finished.", farm.frames_done),
        ("terrafarm_jobs_total", "Jobs whose pixels were used.", farm.jobs_done),
        (
            "terrafarm_jobs_repeated_total",
            "Leases that had to be granted again.",
            farm.jobs_repeated,
        ),
        (
            "terrafarm_blobs_damaged_total",
            "Blobs of terrain that came to workers, or lay there, damaged.",
            farm.blobs_damaged,
        ),
        (
            "terrafarm_terrain_given_bytes_total",
            "Terrain that workers gave to each other.",
            farm.given_bytes,
        ),
        ("terrafarm_results_refused_total", "Results that came too late.", farm.results_refused),
    ];
    for (name, help, value) in counters {
        text.one(name, "counter", help, value as f64);
    }
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text.0).into_response()
}

/// `GET /healthz`: 503 from the moment on at which the coordinator stops.
pub(super) async fn health(State(desk): State<Arc<Desk>>) -> Response {
    let stops = desk.stop.is_cancelled();
    let status = if stops { StatusCode::SERVICE_UNAVAILABLE } else { StatusCode::OK };
    let state = if stops { "stopping" } else { "serving" };
    (status, Json(json!({"status": state}))).into_response()
}
