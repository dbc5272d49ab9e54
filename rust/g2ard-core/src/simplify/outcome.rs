//! From the rounds of a policy back to the rows and the coordinates of the caller.

use super::{GONE, Ordered, SceneRef, Step};
use crate::Splats;
use crate::backend::Numbered;

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
    /// See [`Numbered`].
    numbers: Vec<u32>,
    /// The number that the next new row gets.
    next: u32,
}

impl Trail {
    /// Before the first round: every row is a copy of itself, and none is flagged.
    pub fn start(splats: Splats) -> Self {
        let rows: Vec<u32> = (0..splats.len() as u32).collect();
        Self {
            numbers: rows.clone(),
            next: rows.len() as u32,
            step: Step {
                parents: rows.clone(),
                flags: vec![false; rows.len()],
                copied: rows,
                splats,
            },
        }
    }

    pub fn rows(&self) -> Numbered<'_> {
        Numbered {
            splats: &self.step.splats,
            numbers: &self.numbers,
        }
    }

    pub fn then(&mut self, next: Step) {
        let through = |rows: &[u32], map: &[u32]| -> Vec<u32> {
            let follow = |&p: &u32| if p == GONE { GONE } else { map[p as usize] };
            rows.iter().map(follow).collect()
        };
        let number = |&source: &u32| {
            if source != GONE {
                return self.numbers[source as usize];
            }
            self.next += 1;
            self.next - 1
        };
        self.numbers = next.copied.iter().map(number).collect();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_keep_their_numbers_and_new_rows_get_new_ones() {
        let step = |copied: Vec<u32>, parents: Vec<u32>| Step {
            splats: Splats {
                means: vec![[0.0; 3]; copied.len()],
                ..Splats::default()
            },
            flags: vec![false; copied.len()],
            parents,
            copied,
        };
        let mut trail = Trail::start(step(vec![0; 4], Vec::new()).splats);
        assert_eq!(trail.rows().numbers, [0, 1, 2, 3]);
        trail.then(step(vec![GONE, 3, GONE], vec![0, 0, 2, 1]));
        assert_eq!(trail.rows().numbers, [4, 3, 5]);
        trail.then(step(vec![2, GONE], vec![1, 1, 0]));
        assert_eq!(trail.rows().numbers, [5, 6]);
        assert_eq!(trail.step.parents, [1, 1, 0, 1]);
    }
}
