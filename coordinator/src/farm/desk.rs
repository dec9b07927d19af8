//! What the farm shows of itself, and the orders it takes.

use super::{Farm, Peer};
use crate::order::{Order, OrderError};
use crate::shots::Shot;
use crate::view::{FarmView, JobView, ShotState, ShotView, WorkerState, WorkerView};
use terrafarm_common::id::{FrameIndex, ShotId};
use terrafarm_sched::{Event, Micros};
use terrafarm_wire::message::{Drain, ShotFailed};

impl Farm {
    /// Everything at this moment.
    pub fn view(&self, now: Micros) -> FarmView {
        let account = self.scheduler.account();
        let shots: Vec<_> = self.shots.iter().map(|(id, state)| view_shot(id, state)).collect();
        FarmView {
            at_ms: now.0 / 1000,
            workers: self.view_workers(),
            jobs_running: self.scheduler.leases_held() as u64,
            jobs_done: account.accepted,
            jobs_repeated: account.failed + account.expired + account.lost,
            results_refused: account.refused,
            frames_done: shots.iter().map(|shot| u64::from(shot.frames_done)).sum(),
            shots,
            history: Vec::new(),
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
                self.known(shot)?;
                if !self.workers.contains_key(&worker) {
                    return Err(OrderError::NoWorker(worker));
                }
                self.schedule(now, Event::WorkerCleared { worker, shot: Some(shot) });
                Ok(format!("{worker} gets jobs of {shot} again"))
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
        let held = self.granted.values().filter(|job| job.shot == shot && job.frame == frame);
        let names: Vec<_> = held
            .filter_map(|job| self.workers.get(&job.worker))
            .map(|worker| worker.greeting.name.as_str())
            .collect();
        Ok(match names.len() {
            0 => "no job of it runs".to_owned(),
            jobs => format!("{jobs} jobs of it run, on {}", names.join(", ")),
        })
    }

    fn view_workers(&self) -> Vec<WorkerView> {
        let view = |(&id, state): (&_, &super::WorkerState)| {
            let first = state.leases.first().and_then(|lease| self.granted.get(lease));
            WorkerView {
                id,
                name: state.greeting.name.clone(),
                threads: state.greeting.threads,
                state: if state.leases.is_empty() { WorkerState::Idle } else { WorkerState::Busy },
                speed: 1.0,
                job: first.map(|job| JobView {
                    shot: job.shot,
                    frame: job.frame,
                    region: [job.region.x, job.region.y, job.region.width, job.region.height],
                }),
                jobs_held: state.leases.len() as u32,
                jobs_done: 0,
                jobs_failed: 0,
                heard_ms: 0,
                rendering: 0.0,
                terrain: 0.0,
                blocked: Vec::new(),
                distrusted: false,
            }
        };
        self.workers.iter().map(view).collect()
    }
}

fn view_shot(id: ShotId, state: &Shot) -> ShotView {
    ShotView {
        id,
        name: state.submit.name.clone(),
        state: ShotState::Running,
        note: String::new(),
        priority: state.submit.priority,
        queued: false,
        frames: state.submit.frames,
        frames_done: state.frames_done,
        frames_failed: state.frames_failed,
        size: [state.submit.width, state.submit.height],
        method: state.submit.quality.method.name().to_owned(),
        submitted_s: 0,
        frames_per_s: 0.0,
        eta_s: None,
        last_frame: None,
    }
}
