//! A grid of heights, read or made up, and as a store in memory.

use crate::oracles::stores::{Plan, resident};
use std::fmt::Write;
use std::path::Path;
use terrafarm_raster::{OpenOptions, Window, open};
use terrafarm_terrain::resident::Resident;

pub struct Grid {
    pub columns: usize,
    pub rows: usize,
    /// Distance of posts along both axes, metres.
    pub step_m: f64,
    /// Row by row from the south-west.
    pub heights: Vec<f32>,
}

impl Grid {
    /// What `tests/record-viewsheds` has GRASS look at.
    pub fn procedural() -> Self {
        let hill = |n: i64, period: i64| {
            let n = n.rem_euclid(2 * period) - period;
            n * n / period
        };
        let height = |i: i64, j: i64| {
            7 * hill(3 * i + j + 20, 150) + 4 * hill(5 * j - 3 * i + 400, 190)
                - 2 * hill(7 * i - 4 * j + 700, 140)
                + (7 * i * i + 13 * j * j + 5 * i * j) % 7
        };
        let posts = (0..120).flat_map(|j| (0..120).map(move |i| (i, j)));
        let heights = posts.map(|(i, j)| height(i, j) as f32 / 8.0).collect();
        Grid { columns: 120, rows: 120, step_m: 10.0, heights }
    }

    /// The inner part of a file of square cells, `margin` samples from every side.
    pub fn read(path: &Path, margin: u64) -> Self {
        let raster = open(path, &OpenOptions::default()).unwrap();
        let info = raster.info();
        let step = info.transform.unwrap();
        assert_eq!(step.step_column[0], -step.step_row[1], "cells are square, north is up");
        let window = Window {
            column: margin,
            row: margin,
            width: (info.width - 2 * margin) as usize,
            height: (info.height - 2 * margin) as usize,
        };
        let (columns, rows) = (window.width, window.height);
        let mut heights = vec![0.0; columns * rows];
        raster.read_heights(window, &mut heights).unwrap();
        assert!(heights.iter().all(|height| height.is_finite()), "the margin is too small");
        let from_south = heights.chunks_exact(columns).rev().flatten().copied().collect();
        Grid { columns, rows, step_m: step.step_column[0], heights: from_south }
    }

    pub fn post(&self, i: i64, j: i64) -> f64 {
        f64::from(self.heights[j as usize * self.columns + i as usize])
    }

    /// Post (0, 0) at the origin.
    pub fn resident(&self) -> Resident {
        let posts = [self.columns as u64, self.rows as u64];
        let height = |i, j| self.heights[(j * posts[0] + i) as usize];
        resident(vec![Plan::heights([0.0; 2], [self.step_m; 2], posts, height)])
    }

    /// As an ESRI ASCII grid, with a corner that UTM has, too.
    pub fn esri_ascii(&self) -> String {
        let mut text = format!(
            "ncols {}\nnrows {}\nxllcorner 500000\nyllcorner 5000000\ncellsize {}\n",
            self.columns, self.rows, self.step_m
        );
        for row in self.heights.chunks_exact(self.columns).rev() {
            for height in row {
                write!(text, "{height:.3} ").unwrap();
            }
            text.push('\n');
        }
        text
    }
}
