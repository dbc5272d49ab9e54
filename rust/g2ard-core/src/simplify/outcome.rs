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
    /// Per output row, see [`Step::protected`].
    pub protected: Vec<bool>,
    pub rounds: Vec<R>,
    /// Merged rows whose α was clipped, so that some of their mass is lost.
    pub clamped_opacities: usize,
    /// Infinite logits, clamped.
    pub infinite_logits: usize,
}

impl Step {
    /// Before the first round: every row is a copy of itself, and none is flagged.
    pub fn start(splats: Splats) -> Self {
        let rows: Vec<u32> = (0..splats.len() as u32).collect();
        Self {
            parents: rows.clone(),
            protected: vec![false; rows.len()],
            copied: rows,
            splats,
        }
    }

    /// Both steps as one: parents and copies of `next` followed back to the rows that this one began with.
    pub fn then(self, next: Self) -> Self {
        let through = |rows: &[u32], map: &[u32]| -> Vec<u32> {
            let follow = |&p: &u32| if p == GONE { GONE } else { map[p as usize] };
            rows.iter().map(follow).collect()
        };
        Self {
            parents: through(&self.parents, &next.parents),
            copied: through(&next.copied, &self.copied),
            ..next
        }
    }

    /// Back to the caller's rows and coordinates: adds the origin, except to copied rows, whose mean is the
    /// caller's own, bit for bit.
    pub fn finish<R>(self, scene: &SceneRef, ordered: &Ordered, rounds: Vec<R>) -> Outcome<R> {
        let Self {
            mut splats,
            parents,
            protected,
            copied,
        } = self;
        for (mean, &source) in splats.means.iter_mut().zip(&copied) {
            *mean = if source == GONE {
                [0, 1, 2].map(|k| mean[k] + ordered.bounds.origin[k])
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
            protected,
            rounds,
            clamped_opacities: 0,
            infinite_logits: ordered.infinite_logits,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parents_and_copies_are_followed_through_rounds() {
        let step = |copied: Vec<u32>, parents: Vec<u32>| Step {
            splats: Splats {
                means: vec![[0.0; 3]; copied.len()],
                ..Splats::default()
            },
            protected: vec![false; copied.len()],
            parents,
            copied,
        };
        let start = Step::start(step(vec![0; 4], Vec::new()).splats);
        let once = start.then(step(vec![GONE, 3, GONE], vec![0, 0, 2, 1]));
        assert_eq!(
            (&once.parents[..], &once.copied[..]),
            (&[0, 0, 2, 1][..], &[GONE, 3, GONE][..])
        );
        let twice = once.then(step(vec![1, GONE], vec![1, 0, GONE]));
        assert_eq!(twice.parents, [1, 1, GONE, 0]);
        assert_eq!(twice.copied, [3, GONE]);
    }
}
