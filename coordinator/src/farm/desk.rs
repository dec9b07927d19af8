//! What the farm shows of itself, and the orders it takes.

use super::tally::ShotTally;
use super::{Farm, Peer};
use crate::order::{Order, OrderError};
use crate::shots::Shot;
use crate::view::{CacheView, FarmView, JobView, ShotState, ShotView, WorkerState, WorkerView};
use terrafarm_common::id::{FrameIndex, ShotId};
use terrafarm_sched::{Event, Micros, Why};
use terrafarm_wire::message::{Drain, ShotFailed};

/// How many workers a sentence names; of more it gives the number.
const NAMED: usize = 8;

impl Farm {
    /// Everything at this moment, which is `wall_s` seconds after 1970 began.
    pub fn view(&mut self, now: Micros, wall_s: u64) -> FarmView {
        self.tally.advance(now);
        let account = self.scheduler.account();
        let shots = self.shots.iter().map(|(id, shot)| self.view_shot(now, wall_s, id, shot));
        FarmView {
            at_ms: now.0 / 1000,
            workers: self.view_workers(now),
            jobs_running: self.scheduler.leases_held() as u64,
            jobs_done: account.accepted,
            jobs_repeated: account.failed + account.expired + account.lost,
            results_refused: account.refused,
            frames_done: self.tally.frames_done,
            blobs_damaged: self.tally.blobs_damaged,
            given_bytes: self.tally.given_bytes,
            shots: shots.collect(),
            history: self.tally.history(),
        }
    }

    /// Carries an order out and says what came of it.
    ///
    /// # Errors
    /// If there is nothing that it could be carried out on.
    pub fn order(&mut self, now: Micros, order: Order) -> Result<String, OrderError> {
        match order {
            Order::Pause(shot) => {
                self.known(shot)?;
                self.schedule(now, Event::ShotPaused { shot });
                Ok(format!("{shot} waits"))
            }
            Order::Resume(shot) => {
                self.known(shot)?;
                self.schedule(now, Event::ShotResumed { shot });
                Ok(format!("{shot} goes on"))
            }
            Order::Prioritise(shot, priority) => {
                self.known(shot)?;
                self.schedule(now, Event::ShotPrioritised { shot, priority });
                Ok(format!("{shot} has priority {priority}"))
            }
            Order::Cancel(shot) => {
                let client = self.shots.get(shot).ok_or(OrderError::NoShot(shot))?.client;
                self.schedule(now, Event::ShotCanceled { shot });
                self.forget_shot(shot);
                let reason = "canceled by an operator".into();
                self.send(Peer::Client(client), ShotFailed { shot, reason });
                Ok(format!("{shot} is canceled"))
            }
            Order::Clear(worker, shot) => {
                shot.map_or(Ok(()), |shot| self.known(shot))?;
                if !self.workers.contains_key(&worker) {
                    return Err(OrderError::NoWorker(worker));
                }
                self.schedule(now, Event::WorkerCleared { worker, shot });
                Ok(match shot {
                    Some(shot) => format!("{worker} gets jobs of {shot} again"),
                    None => format!("{worker} is trusted and gets jobs of every shot again"),
                })
            }
            Order::Drain(worker) => {
                if !self.workers.contains_key(&worker) {
                    return Err(OrderError::NoWorker(worker));
                }
                self.send(Peer::Worker(worker), Drain {});
                self.schedule(now, Event::WorkerDraining { worker });
                Ok(format!("{worker} finishes what it renders and leaves"))
            }
            Order::Why(shot, frame) => self.why(shot, frame),
        }
    }

    /// The number of a frame within its flight.
    pub(super) fn number(&self, shot: ShotId, frame: FrameIndex) -> FrameIndex {
        self.shots.get(shot).map_or(frame, |shot| shot.number(frame))
    }

    fn known(&self, shot: ShotId) -> Result<(), OrderError> {
        self.shots.get(shot).map(|_| ()).ok_or(OrderError::NoShot(shot))
    }

    /// Why a frame is not done.
    fn why(&self, shot: ShotId, frame: FrameIndex) -> Result<String, OrderError> {
        let state = self.shots.get(shot).ok_or(OrderError::NoShot(shot))?;
        let frames = state.submit.frames;
        if frame >= frames {
            return Err(OrderError::NoFrame { shot, frames, frame });
        }
        Ok(match self.scheduler.why(shot, frame) {
            // Names say more to people than numbers.
            Why::Running { jobs, workers, waiting } => {
                let names = workers.iter().filter_map(|worker| self.workers.get(worker));
                let names: Vec<_> = names.map(|state| state.greeting.name.as_str()).collect();
                let others = names.len().saturating_sub(NAMED);
                let mut text = match jobs {
                    1 => "1 job runs, on ".to_owned(),
                    jobs => format!("{jobs} jobs run, on "),
                };
                text += &names[..names.len() - others].join(", ");
                if others > 0 {
                    text += &format!(" and {others} others");
                }
                if waiting > 0 {
                    text += &format!("; {waiting} wait for a worker");
                }
                text
            }
            why => why.to_string(),
        })
    }

    fn view_workers(&self, now: Micros) -> Vec<WorkerView> {
        let view = |(&id, state): (&_, &super::WorkerState)| {
            let first = state.leases.first().and_then(|lease| self.granted.get(lease));
            let tally = self.tally.workers.get(&id);
            let status = tally.and_then(|tally| tally.status);
            let threads = state.greeting.threads;
            let [rendering, terrain] = tally.map_or([0.0; 2], |tally| tally.shares(now));
            WorkerView {
                id,
                name: state.greeting.name.clone(),
                threads,
                threads_allowed: status
                    .map_or(threads, |status| status.threads_allowed.min(threads)),
                state: if self.scheduler.is_draining(id) {
                    WorkerState::Draining
                } else if state.leases.is_empty() {
                    WorkerState::Idle
                } else {
                    WorkerState::Busy
                },
                speed: self.scheduler.speed_of(id).unwrap_or(1.0),
                job: first.map(|job| JobView {
                    shot: job.shot,
                    frame: self.number(job.shot, job.frame),
                    region: [job.region.x, job.region.y, job.region.width, job.region.height],
                }),
                jobs_held: state.leases.len() as u32,
                jobs_done: tally.map_or(0, |tally| tally.jobs_done),
                jobs_failed: tally.map_or(0, |tally| tally.jobs_failed),
                heard_ms: self.scheduler.heard_at(id).map_or(0, |heard| now.since(heard) / 1000),
                rendering,
                terrain,
                blocked: tally
                    .map_or_else(Vec::new, |tally| tally.blocked.iter().copied().collect()),
                distrusted: self.scheduler.is_distrusted(id),
                cache: status.map(|status| CacheView {
                    memory_bytes: status.memory_bytes,
                    memory_limit_bytes: status.memory_limit_bytes,
                    disk_bytes: status.disk_bytes,
                    disk_limit_bytes: status.disk_limit_bytes,
                    damaged: status.damaged,
                    given_bytes: status.given_bytes,
                }),
            }
        };
        self.workers.iter().map(view).collect()
    }

    fn view_shot(&self, now: Micros, wall_s: u64, id: ShotId, shot: &Shot) -> ShotView {
        let fresh = ShotTally::default();
        let tally = self.tally.shots.get(&id).unwrap_or(&fresh);
        let submit = &shot.submit;
        let left = submit.frames.saturating_sub(shot.frames_done + shot.frames_failed);
        let frames_per_s = tally.frames_per_s(now);
        let is_paused = self.scheduler.is_paused(id);
        let will_end = frames_per_s > 0.0 && !is_paused;
        ShotView {
            id,
            name: submit.name.clone(),
            state: if is_paused { ShotState::Paused } else { ShotState::Running },
            note: String::new(),
            priority: self.scheduler.priority(id).unwrap_or(submit.priority),
            queued: shot.queued,
            first_frame: 0,
            frames: submit.frames,
            frames_done: shot.frames_done,
            frames_failed: shot.frames_failed,
            size: [submit.width, submit.height],
            method: submit.quality.method.name().to_owned(),
            submitted_s: wall_s.saturating_sub(now.since(shot.since) / 1_000_000),
            frames_per_s,
            eta_s: will_end.then(|| f64::from(left) / frames_per_s),
            last_frame: tally.last_frame.map(|frame| shot.number(frame)),
            film: false,
            history: Vec::new(),
        }
    }
}
