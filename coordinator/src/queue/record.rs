//! What is kept of shots and frames, and how it is read back: what was damaged costs the shot
//! or the frame that it was of, and nothing else.

use super::QueueError;
use super::plan::{ShotPlan, Source};
use crate::sink::manifest::{FrameEntry, WorkerEntry};
use crate::view::Past;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::time::{SystemTime, UNIX_EPOCH};
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::{Shading, Sky};
use terrafarm_wire::limits::clip_name;

/// Most that is kept of a shot's history.
const HISTORY_MAX: usize = 32;

/// How far a shot has come, as it is kept. What it does at the moment follows from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Frames are missing.
    Open,
    /// Frames are missing, and someone wants it to wait.
    Paused,
    /// Manifest and film are missing.
    Finishing,
    /// All is there.
    Done,
    /// It was given up.
    Failed,
    /// Someone canceled it.
    Canceled,
}

impl Stage {
    /// Whether nothing is left to do.
    pub fn is_over(self) -> bool {
        matches!(self, Stage::Done | Stage::Failed | Stage::Canceled)
    }
}

/// One shot, without its cameras.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShotRecord {
    /// What was submitted; the cameras are kept apart.
    pub plan: ShotPlan,
    /// Number of frames.
    pub frames: u32,
    /// When it was submitted, seconds since 1970.
    pub submitted_s: u64,
    /// How far it has come.
    pub stage: Stage,
    /// Why, where that needs saying.
    pub note: String,
    /// Who rendered, as far as the farm has said.
    pub workers: Vec<WorkerEntry>,
    /// What happened to it that people should know of, oldest first.
    #[serde(default)]
    pub history: Vec<Past>,
}

/// What became of one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameRecord {
    /// Its picture is on the disk.
    Done {
        /// Its entry in the manifest.
        entry: FrameEntry,
        /// Size of the picture's file, bytes.
        bytes: u64,
    },
    /// It could not be rendered, for this reason.
    Failed(String),
}

/// How many frames of a shot are over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Progress {
    /// Finished.
    pub done: u32,
    /// Given up.
    pub failed: u32,
    /// The one that was finished last.
    pub last: Option<FrameIndex>,
}

impl Progress {
    /// Frames that are over.
    pub fn over(self) -> u32 {
        self.done.saturating_add(self.failed)
    }

    /// From its row of the ledger.
    pub(super) fn from_row((done, failed, next): (u32, u32, u32)) -> Self {
        Progress { done, failed, last: next.checked_sub(1) }
    }

    /// Its row of the ledger.
    pub(super) fn row(self) -> (u32, u32, u32) {
        (self.done, self.failed, self.last.map_or(0, |last| last.saturating_add(1)))
    }
}

/// A shot as it was read.
#[derive(Debug, Clone, PartialEq)]
pub struct Saved {
    /// Its number.
    pub id: ShotId,
    /// What is kept of it.
    pub record: ShotRecord,
    /// How far it is.
    pub progress: Progress,
}

impl ShotRecord {
    /// Notes what happened to it just now; of too much, the oldest is forgotten.
    pub fn happened(&mut self, what: String) {
        if self.history.len() >= HISTORY_MAX {
            self.history.remove(0);
        }
        let at_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        self.history.push(Past { at_s, what });
    }

    /// Reads what was kept of a shot. One that cannot be read, or that no farm would render,
    /// is a shot that failed, and its note says why: what is on the disk is left as it is.
    pub fn read(text: &[u8]) -> Self {
        let failed = |why: &dyn std::fmt::Display| {
            Self::unreadable(text, format!("its record is damaged: {why}; submit it again"))
        };
        match serde_json::from_slice::<ShotRecord>(text) {
            Err(why) => failed(&why),
            Ok(record) if record.stage.is_over() => record,
            Ok(record) => match record.plan.check_kept(record.frames) {
                Err(QueueError::Unfit(why)) => failed(&why),
                _ => record,
            },
        }
    }

    /// What can be told of a shot whose record is damaged.
    fn unreadable(text: &[u8], note: String) -> Self {
        let json: Value = serde_json::from_slice(text).unwrap_or_default();
        let plan = &json["plan"];
        let small = |value: &Value| {
            value.as_u64().and_then(|number| u32::try_from(number).ok()).unwrap_or(0)
        };
        ShotRecord {
            frames: small(&json["frames"]),
            submitted_s: json["submitted_s"].as_u64().unwrap_or(0),
            stage: Stage::Failed,
            note,
            workers: Vec::new(),
            history: Vec::new(),
            plan: ShotPlan {
                name: clip_name(plan["name"].as_str().unwrap_or("unreadable")),
                priority: plan["priority"]
                    .as_i64()
                    .and_then(|n| i32::try_from(n).ok())
                    .unwrap_or(0),
                index: BlobHash([0; 32]),
                shading: Shading {
                    sun: None,
                    haze: None,
                    sky: Sky::default(),
                    earth: None,
                    below_ground: [0.0; 3],
                    bare_ground: None,
                },
                quality: Quality::default(),
                check: Share::NONE,
                size: [small(&plan["size"][0]), small(&plan["size"][1])],
                split: Split::default(),
                fps: 1.0,
                first_frame: small(&plan["first_frame"]),
                cameras: Vec::new(),
                frames_in_flight: 1,
                film: None,
                source: Source::default(),
            },
        }
    }
}

impl FrameRecord {
    /// Reads what was kept of a frame; `None` if it is damaged.
    pub fn read(text: &[u8]) -> Option<Self> {
        serde_json::from_slice(text).ok()
    }
}
