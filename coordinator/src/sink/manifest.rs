//! `manifest.json`: what a render was made of, and what came out. Scripts read it: keys
//! are added freely, never renamed.

use super::beside::Beside;
use super::{SinkError, pixels_sha256};
use crate::client::FrameFacts;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use terrafarm_common::accuracy::Summary;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;
use terrafarm_wire::message::WorkerShare;

/// Everything about one render.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Name and version of the program that made it.
    pub program: String,
    /// The scene file, as it was named.
    pub scene: String,
    /// SHA-256 of the scene file, hexadecimal.
    pub scene_sha256: String,
    /// The terrain store, as the scene names it.
    pub terrain: String,
    /// SHA-256 of the store's index, hexadecimal: it stands for every tile.
    pub terrain_sha256: String,
    /// The flight file, as it was named; absent for a built-in flight.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub flight: Option<String>,
    /// What was written: the file, or the folder of a sequence.
    pub output: String,
    /// Name of the method.
    pub method: String,
    /// Samples along each side of a pixel.
    pub samples: u32,
    /// The error that the method was allowed, pixels, if it takes such a setting.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub tolerance_px: Option<f64>,
    /// Width and height of the frames, pixels.
    pub size: [u32; 2],
    /// Frames per second.
    pub fps: f64,
    /// Samples of all frames that the method could not do its own way and gave a ray of
    /// their own: what `column` does where neighbouring rays see different ground.
    #[serde(default)]
    pub fallbacks: u64,
    /// Their share of all samples, 0 to 1: of the pixels, if `samples` is 1.
    #[serde(default)]
    pub fallback_share: f64,
    /// Of a live shot: pixels of all frames that show coarser terrain than was asked for,
    /// because it had not come.
    #[serde(default)]
    pub coarser_pixels: u64,
    /// The frames, in order; those that failed are left out.
    pub frames: Vec<FrameEntry>,
    /// Frames that could not be rendered, and why.
    pub failed: BTreeMap<FrameIndex, String>,
    /// Who rendered.
    pub workers: Vec<WorkerEntry>,
}

/// What one worker did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorkerEntry {
    /// Its name.
    pub name: String,
    /// Jobs whose pixels were used.
    pub jobs: u64,
    /// Time it rendered for them, milliseconds.
    pub render_ms: f64,
}

/// One frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameEntry {
    /// Index, from 0.
    pub index: FrameIndex,
    /// SHA-256 of the pixels, hexadecimal: see [`super::pixels_sha256`].
    pub sha256: String,
    /// From the first lease of the frame to its last pixel, milliseconds.
    pub ms: f64,
    /// Time that workers rendered for it, all jobs together, milliseconds.
    pub render_ms: f64,
    /// Number of jobs it was made of.
    pub jobs: u32,
    /// As [`Manifest::fallbacks`], of this frame.
    #[serde(default)]
    pub fallbacks: u64,
    /// As [`Manifest::fallback_share`], of this frame.
    #[serde(default)]
    pub fallback_share: f64,
    /// As [`Manifest::coarser_pixels`], of this frame.
    #[serde(default)]
    pub coarser_pixels: u64,
    /// Whether the camera was below the ground.
    pub below_ground: bool,
    /// With `--check`: 99th percentile of the error, pixels.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub error_px_p99: Option<f64>,
    /// With `--check`: the largest error, pixels; 64 stands for 64 and more.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub error_px_max: Option<f64>,
    /// With `--check`: 99th percentile of the error in depth, metres; absent if nothing
    /// but sky was measured.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub depth_error_m_p99: Option<f64>,
    /// With `--check`: share of pixels that see another part of the ground.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mismatch: Option<f64>,
    /// With `--check`: number of pixels that were measured.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub checked_pixels: Option<u64>,
}

impl FrameEntry {
    /// The entry of a finished picture of this many samples a side of a pixel. The share of
    /// fallbacks is at most 1, whatever workers counted.
    pub fn new(index: FrameIndex, picture: &Rgb8, facts: &FrameFacts, samples: u32) -> Self {
        let pixels = u64::from(picture.width()) * u64::from(picture.height());
        let samples = pixels * u64::from(samples).pow(2);
        let fallbacks = facts.fallbacks.min(samples);
        let errors = facts.check.as_ref();
        let error_px = errors.and_then(Summary::error_px);
        FrameEntry {
            index,
            sha256: pixels_sha256(picture).to_hex(),
            ms: facts.elapsed_us as f64 / 1e3,
            render_ms: facts.cost_us as f64 / 1e3,
            jobs: facts.jobs,
            fallbacks,
            fallback_share: fallbacks as f64 / samples.max(1) as f64,
            coarser_pixels: facts.coarser.min(pixels),
            below_ground: facts.below_ground,
            error_px_p99: error_px.map(|error| error.p99),
            error_px_max: error_px.map(|error| error.max),
            depth_error_m_p99: errors.and_then(Summary::depth_m).map(|depth| depth.p99),
            mismatch: error_px.and(errors).map(Summary::mismatch),
            checked_pixels: errors.map(Summary::samples),
        }
    }
}

impl WorkerEntry {
    /// What the farm says of a worker.
    pub fn new(share: &WorkerShare) -> Self {
        WorkerEntry {
            name: share.name.clone(),
            jobs: share.jobs,
            render_ms: share.cost_us as f64 / 1e3,
        }
    }
}

impl Manifest {
    /// Writes the manifest beside an output, whole or not at all; returns where it is.
    pub fn save(&self, output: &Path) -> Result<PathBuf, SinkError> {
        let path = place(output);
        let mut text = serde_json::to_vec_pretty(self)
            .map_err(|error| SinkError::output(&path, error.to_string()))?;
        text.push(b'\n');
        let mut file = Beside::create(&path)?;
        file.write(&text)?;
        file.commit()?;
        Ok(path)
    }
}

/// Where the manifest of an output is: in the folder of a sequence, next to a file.
pub fn place(output: &Path) -> PathBuf {
    if output.is_dir() {
        return output.join("manifest.json");
    }
    output.with_file_name("manifest.json")
}
