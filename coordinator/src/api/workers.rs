//! Routes about workers and the farm as a whole.

use super::Desk;
use super::board::{Board, Page, Window};
use super::refusal::Refusal;
use super::shots::{Answer, worker_id};
use crate::order::Order;
use crate::view::{ShotState, WorkerState};
use axum::Json;
use axum::extract::{Path, Query, State};
use serde_json::{Value, json};
use std::sync::Arc;

/// `GET /api/v1/workers`
pub(super) async fn list(State(desk): State<Arc<Desk>>, Query(window): Query<Window>) -> Answer {
    let board = desk.board();
    Ok(Json(list_json(&board, &window)?))
}

/// A page of the list of workers, as JSON.
pub(super) fn list_json(board: &Board, window: &Window) -> Result<Value, Refusal> {
    let Page { total, offset, entries } = board.page_of_workers(window)?;
    Ok(json!({"total": total, "offset": offset, "workers": entries}))
}

/// `POST /api/v1/workers/{worker}/drain`
pub(super) async fn drain(State(desk): State<Arc<Desk>>, Path(worker): Path<String>) -> Answer {
    Ok(Json(json!({"done": desk.order(Order::Drain(worker_id(&worker)?)).await?})))
}

/// `POST /api/v1/workers/{worker}/clear`
pub(super) async fn clear(State(desk): State<Arc<Desk>>, Path(worker): Path<String>) -> Answer {
    Ok(Json(json!({"done": desk.order(Order::Clear(worker_id(&worker)?, None)).await?})))
}

/// `GET /api/v1/farm`
pub(super) async fn farm(State(desk): State<Arc<Desk>>) -> Answer {
    let board = desk.board();
    let mut totals = desk.totals(&board);
    totals["history"] = json!(board.farm.history);
    Ok(Json(totals))
}

impl Desk {
    /// The farm in numbers, without its history.
    pub(super) fn totals(&self, board: &Board) -> Value {
        let farm = &board.farm;
        let workers = WorkerCounts::of(board);
        let shots: serde_json::Map<_, _> = ShotState::ALL
            .into_iter()
            .map(|state| {
                let count = board.states.get(&state).copied().unwrap_or(0);
                (state.name().to_owned(), count.into())
            })
            .collect();
        let now = farm.history.last();
        json!({
            "name": self.name,
            "program": terrafarm_wire::link::program(),
            "queue": self.queue.is_some(),
            "at_ms": farm.at_ms,
            "workers": {
                "connected": farm.workers.len(),
                "idle": workers.idle,
                "busy": workers.busy,
                "draining": workers.draining,
                "threads": workers.threads,
                "threads_allowed": workers.threads_allowed,
            },
            "shots": shots,
            "jobs_running": farm.jobs_running,
            "jobs_done": farm.jobs_done,
            "jobs_repeated": farm.jobs_repeated,
            "results_refused": farm.results_refused,
            "frames_done": farm.frames_done,
            "blobs_damaged": farm.blobs_damaged,
            "given_bytes": farm.given_bytes,
            "now": now,
        })
    }
}

/// How many workers do what.
#[derive(Debug, Default)]
pub(super) struct WorkerCounts {
    /// Without a job.
    pub idle: usize,
    /// With one.
    pub busy: usize,
    /// On their way out.
    pub draining: usize,
    /// Render threads of all.
    pub threads: u64,
    /// Those that may render now.
    pub threads_allowed: u64,
}

impl WorkerCounts {
    /// Of everyone connected.
    pub fn of(board: &Board) -> Self {
        let mut counts = WorkerCounts::default();
        for worker in &board.farm.workers {
            match worker.state {
                WorkerState::Idle => counts.idle += 1,
                WorkerState::Busy => counts.busy += 1,
                WorkerState::Draining => counts.draining += 1,
            }
            counts.threads += u64::from(worker.threads);
            counts.threads_allowed += u64::from(worker.threads_allowed);
        }
        counts
    }
}
