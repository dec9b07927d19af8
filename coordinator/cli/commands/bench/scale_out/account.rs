//! Where the time of the workers of a shot went: parts that add up to all of it.

use serde::Serialize;
use terrafarm_wire::message::{ShotDone, WorkerShare};

/// Shares of the time of all workers, each counted from the submission to the last frame.
/// They add up to 1. Keys are promises.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Account {
    /// Rendering, on a core.
    pub render: f64,
    /// Rendering, while another process had the core: more workers than cores, say.
    pub coreless: f64,
    /// Before the first grant of a worker.
    pub start: f64,
    /// Waiting for terrain to come over the network.
    pub terrain: f64,
    /// Checking and unpacking terrain.
    pub unpack: f64,
    /// Packing pixels.
    pub encode: f64,
    /// Waiting for the network to take pixels.
    pub send: f64,
    /// Without a job between the first and the last: the coordinator, or a limit of frames
    /// under way.
    pub coordinator: f64,
    /// After the last result of a worker.
    pub tail: f64,
    /// Jobs of which nothing was used.
    pub redo: f64,
    /// Handing over from thread to thread within a worker.
    pub hand_over: f64,
    /// The rest: the way of the first grant and of the last result.
    pub other: f64,
}

impl Account {
    /// Names of the parts, for people, in their order.
    pub const NAMES: [&'static str; 12] = [
        "render",
        "no core",
        "start",
        "terrain",
        "unpack",
        "encode",
        "send",
        "coordinator",
        "tail",
        "redo",
        "hand-over",
        "other",
    ];

    /// The account of a shot by so many workers; those that did nothing waited all the time.
    pub fn of(done: &ShotDone, workers: u32) -> Self {
        let wall_us = done.elapsed_us.max(1) as f64;
        let mut sum = Account::default();
        for share in &done.workers {
            sum.add(share, wall_us);
        }
        let absent = f64::from(workers) - done.workers.len() as f64;
        sum.start += absent.max(0.0) * wall_us;
        let total_us = wall_us * f64::from(workers).max(done.workers.len() as f64);
        sum.other = total_us - sum.parts().iter().sum::<f64>();
        Account {
            render: sum.render / total_us,
            coreless: sum.coreless / total_us,
            start: sum.start / total_us,
            terrain: sum.terrain / total_us,
            unpack: sum.unpack / total_us,
            encode: sum.encode / total_us,
            send: sum.send / total_us,
            coordinator: sum.coordinator / total_us,
            tail: sum.tail / total_us,
            redo: sum.redo / total_us,
            hand_over: sum.hand_over / total_us,
            other: sum.other / total_us,
        }
    }

    /// Adds the times of a worker, microseconds.
    fn add(&mut self, share: &WorkerShare, wall_us: f64) {
        let sheet = &share.timesheet;
        self.render += sheet.render_us as f64;
        self.coreless += sheet.coreless_us as f64;
        self.start += share.first_us as f64;
        self.terrain += sheet.terrain_us as f64;
        self.unpack += sheet.unpack_us as f64;
        self.encode += sheet.pack_us as f64;
        self.send += sheet.send_us as f64;
        self.coordinator += sheet.idle_us as f64;
        self.tail += wall_us - share.last_us as f64;
        self.redo += sheet.redo_us as f64;
        self.hand_over += sheet.other_us as f64;
    }

    /// The parts in the order of [`Self::NAMES`].
    pub fn parts(&self) -> [f64; 12] {
        [
            self.render,
            self.coreless,
            self.start,
            self.terrain,
            self.unpack,
            self.encode,
            self.send,
            self.coordinator,
            self.tail,
            self.redo,
            self.hand_over,
            self.other,
        ]
    }

    /// Whether no part is more than a rounding below 0 and all add up to 1.
    pub fn adds_up(&self) -> bool {
        let total: f64 = self.parts().iter().sum();
        (total - 1.0).abs() < 1e-6 && self.parts().iter().all(|&part| part > -1e-3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrafarm_common::id::ShotId;
    use terrafarm_wire::message::{RenderReport, Timesheet};

    #[test]
    fn the_parts_of_a_shot_add_up_with_a_worker_that_did_nothing() {
        let sheet = Timesheet {
            idle_us: 100,
            terrain_us: 50,
            render_us: 600,
            redo_us: 20,
            ..Timesheet::default()
        };
        let share = WorkerShare {
            name: "local-1".into(),
            jobs: 3,
            cost_us: 600,
            first_us: 10,
            last_us: 900,
            timesheet: sheet,
        };
        let done = ShotDone {
            shot: ShotId(1),
            frames_done: 1,
            frames_failed: 0,
            jobs: 3,
            jobs_repeated: 0,
            elapsed_us: 1000,
            report: RenderReport::default(),
            workers: vec![share],
        };
        let account = Account::of(&done, 2);
        assert!(account.adds_up(), "{account:?}");
        assert!((account.render - 0.3).abs() < 1e-12 && (account.start - 0.505).abs() < 1e-12);
        assert!((account.tail - 0.05).abs() < 1e-12 && (account.other - 0.06).abs() < 1e-12);
    }
}
