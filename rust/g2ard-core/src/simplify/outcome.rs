//! From the rounds of a policy back to the rows and the coordinates of the caller.

use super::{GONE, Ordered, SceneRef, Step};
use crate::Splats;

/// The simplified scene in the caller's coordinates, and what became of each of its rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome<R> {
    pub splats: Splats,
    /// Output row of each input row; −1 where it was dropped or trimmed.
    pub parents: Vec<i64>,
    pub flags: Vec<bool>,
    pub rounds: Vec<R>,
    /// Merged rows whose α was clipped, so that some of their mass is lost.
    pub clamped_opacities: usize,
    /// Infinite logits, clamped.
    pub infinite_logits: usize,
}

/// Follows parents and copies through successive steps.
pub struct Trail {
    pub step: Step,
}

impl Trail {
    /// Before the first round: every row is a copy of itself.
    pub fn start(splats: Splats, flags: Vec<bool>) -> Self {
        let rows: Vec<u32> = (0..splats.len() as u32).collect();
        Self {
            step: Step {
                splats,
                parents: rows.clone(),
                flags,
                copied: rows,
            },
        }
    }

    pub fn then(&mut self, next: Step) {
        let through = |rows: &[u32], map: &[u32]| -> Vec<u32> {
            let follow = |&p: &u32| if p == GONE { GONE } else { map[p as usize] };
            rows.iter().map(follow).collect()
        };
        self.step = Step {
            parents: through(&self.step.parents, &next.parents),
            copied: through(&next.copied, &self.step.copied),
            ..next
        };
    }

    /// Back to the caller's rows and coordinates.
    pub fn finish<R>(self, scene: &SceneRef, ordered: &Ordered, rounds: Vec<R>) -> Outcome<R> {
        self.step.finish(scene, ordered, rounds)
    }
}

impl Step {
    /// Back to the caller's rows and coordinates: adds the origin, except to copied rows, whose mean is the
    /// caller's own, bit for bit.
    pub fn finish<R>(self, scene: &SceneRef, ordered: &Ordered, rounds: Vec<R>) -> Outcome<R> {
        let Self {
            mut splats,
            parents,
            flags,
            copied,
        } = self;
        for (mean, &source) in splats.means.iter_mut().zip(&copied) {
            *mean = if source == GONE {
                [0, 1, 2].map(|k| mean[k] + ordered.origin[k])
            } else {
                scene.means.get(ordered.rows[source as usize] as usize)
            };
        }
        let mut by_row = vec![-1i64; parents.len()];
        for (&row, &parent) in ordered.rows.iter().zip(&parents) {
            by_row[row as usize] = if parent == GONE {
                -1
            } else {
                i64::from(parent)
            };
        }
        Outcome {
            splats,
            parents: by_row,
            flags,
            rounds,
            clamped_opacities: 0,
            infinite_logits: ordered.infinite_logits,
        }
    }
}
