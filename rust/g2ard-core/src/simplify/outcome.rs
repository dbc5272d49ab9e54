//! Conversion from the rounds of a method back to the caller's rows and coordinates.

use super::{GONE, Step};
use crate::Splats;
use crate::scene::{Ordered, SceneRef};

/// The simplified scene in the caller's coordinates, and where each input row went.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome<R> {
    pub splats: Splats,
    /// Output row of each input row; −1 where it was dropped or trimmed.
    pub parents: Vec<i64>,
    /// Whether an output row, or a member of it, is protected: in a cell of uneven colour (`residual.rs`).
    pub protected: Vec<bool>,
    pub rounds: Vec<R>,
    /// See [`Step::clamped`].
    pub clamped_opacities: usize,
    /// Infinite logits, clamped.
    pub infinite_logits: usize,
}

impl Step {
    /// Before the first round: every row stays.
    pub fn start(splats: Splats) -> Self {
        Self {
            parents: (0..splats.len() as u32).collect(),
            splats,
            ..Self::default()
        }
    }

    /// Both steps as one.
    pub fn then(self, next: Self) -> Self {
        let follow = |&p: &u32| match p {
            GONE => GONE,
            row => next.parents[row as usize],
        };
        Self {
            parents: self.parents.iter().map(follow).collect(),
            clamped: self.clamped + next.clamped,
            ..next
        }
    }

    /// Whether each row has a parent that is `flagged`.
    pub fn inherited(&self, flagged: &[bool]) -> Vec<bool> {
        let mut out = vec![false; self.splats.len()];
        for (&parent, &flag) in self.parents.iter().zip(flagged) {
            if parent != GONE {
                out[parent as usize] |= flag;
            }
        }
        out
    }

    /// Back to the caller's rows and coordinates: adds the origin, except to rows that nothing was merged into, whose
    /// mean is the caller's own, bit for bit. `protected` are the flags of the output rows.
    pub fn finish<R>(
        mut self,
        scene: &SceneRef,
        ordered: &Ordered,
        protected: Vec<bool>,
        rounds: Vec<R>,
    ) -> Outcome<R> {
        let mut members = vec![0u32; self.splats.len()];
        for &parent in self.parents.iter().filter(|&&p| p != GONE) {
            members[parent as usize] += 1;
        }
        for mean in &mut self.splats.means {
            *mean = [0, 1, 2].map(|k| mean[k] + ordered.bounds.origin[k]);
        }
        let mut parents = vec![-1i64; self.parents.len()];
        for (&row, &parent) in ordered.rows.iter().zip(&self.parents) {
            if parent == GONE {
                continue;
            }
            parents[row as usize] = i64::from(parent);
            if members[parent as usize] == 1 {
                self.splats.means[parent as usize] = scene.means.get(row as usize);
            }
        }
        Outcome {
            splats: self.splats,
            parents,
            protected,
            rounds,
            clamped_opacities: self.clamped,
            infinite_logits: ordered.infinite_logits,
        }
    }
}
