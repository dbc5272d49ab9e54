//! The pairwise policy on one tile of a scene too large for memory, in steps between which the tiles agree on
//! what each of them keeps.
//!
//! All tiles measure in one [`Frame`], so that their costs compare. [`Tile::run_costs`] says what merging along
//! Morton order costs; once it is decided how many runs a tile keeps, [`Tile::plan`] merges pairs of neighbours
//! farther than any budget asks for and tells the order of the merges and their costs; once it is decided how
//! many of those a tile does, [`Tile::assemble`] makes its Gaussians.

use super::clusters::{Pair, Partition};
use super::cost::Weights;
use super::leaves::{Frame, Leaves, Sums, Visibility, unit};
use super::morton_tree::{cut, merge_costs};
use super::pairwise::{PairwiseRound, longest};
use super::rows::Rows;
use super::{GONE, Outcome, Pairwise};
use crate::scene::{Ordered, SceneRef};
use crate::{Control, Error, Result};

impl Frame {
    /// The frame of a scene without views, from all of it or a fair sample.
    pub fn of_sample(policy: &Pairwise, scene: &SceneRef, ordered: &Ordered) -> Self {
        let pixel_size = policy.pixel_without_views(scene);
        let blur = policy.blurs(scene, ordered, None, Some(pixel_size));
        let rows = (0..scene.len() as u32).collect();
        let leaves = Leaves::new(scene, ordered, rows, &blur, None, None);
        Self {
            unit: unit(scene, ordered, &blur),
            pixel_size,
            floor: 0.0,
            even: 0.0,
            importance: leaves.importance(),
        }
    }

    /// The same with views: the median size of a pixel, and the sums of [`Tile::sums`] over all tiles.
    pub fn with_views(self, pixel_size: f32, sums: Sums) -> Self {
        Self {
            pixel_size,
            floor: sums.floor(),
            even: sums.even(&self.importance),
            ..self
        }
    }
}

/// Merges of a tile in the order they are done, over the runs of Morton order that it begins with.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TilePlan {
    /// The run of each ordered row, or [`GONE`] where it is dropped.
    pub run_of: Vec<u32>,
    /// Number of runs.
    pub runs: usize,
    /// Runs `b` joins `a`; each is named by the run that it began with.
    pub merges: Vec<Pair>,
}

/// A tile and its units.
pub struct Tile<'a> {
    pub policy: Pairwise,
    pub scene: &'a SceneRef<'a>,
    pub ordered: &'a Ordered,
    pub visibility: Option<Visibility<'a>>,
    pub frame: Frame,
}

impl Tile<'_> {
    /// Sums over the rows that are kept; the frame's own are not read.
    pub fn sums(&self) -> Result<Sums> {
        let blur = self.blurs();
        Ok(self.leaves(&blur)?.sums())
    }

    /// The cost of closing each gap between neighbours in Morton order, from the first kept row on; `mean_run` is the
    /// number of rows of a run, in the mean over all tiles.
    pub fn run_costs(&self, mean_run: f64) -> Result<Vec<f32>> {
        let blur = self.blurs();
        let leaves = self.leaves(&blur)?;
        let longest = longest(self.policy.longest_run, mean_run);
        Ok(merge_costs(
            &leaves.codes(),
            &leaves,
            self.weights(),
            longest,
        ))
    }

    /// Merge down to `runs` runs along Morton order, then pairs of neighbours in rounds down to each count of
    /// `schedule`; `costs` come from [`Tile::run_costs`].
    pub fn plan(
        &self,
        runs: usize,
        schedule: &[usize],
        costs: &[f32],
        control: &Control,
    ) -> Result<TilePlan> {
        let blur = self.blurs();
        let leaves = self.leaves(&blur)?;
        refuse!(runs == 0 || runs > leaves.len() => "runs", format!("1 to {}", leaves.len()), runs);
        Error::unless_equal("costs", costs.len(), leaves.len() - 1, "gaps")?;
        control.begin((runs - schedule.last().map_or(runs, |&last| last.min(runs))) as u64);
        let (mut nodes, at) = if runs < leaves.len() {
            let parts = cut(costs, runs);
            let mut merged = leaves.merged(&parts, leaves.width());
            // Runs in Morton order anew, and each kept row's run there.
            let every: Vec<u32> = (0..runs as u32).collect();
            let (from, map, _) = merged.morton(&every, [0.0; 3]);
            merged.gather(&from);
            let of = parts.of.iter().map(|&run| map[run as usize]);
            (merged, of.collect::<Vec<u32>>())
        } else {
            (leaves.nodes(), (0..runs as u32).collect())
        };
        let mut run_of = vec![GONE; self.scene.len()];
        for (&row, &run) in leaves.kept.iter().zip(&at) {
            run_of[row as usize] = run;
        }
        // The run that each node began with; a merged node keeps that of the node it was merged into.
        let mut names: Vec<u32> = (0..runs as u32).collect();
        let mut merges = Vec::new();
        let weights = self.weights();
        self.policy
            .merge_rounds(&mut nodes, weights, schedule, control, |pairs, map| {
                let mut next = vec![0; map.len() - pairs.len()];
                for &Pair { a, b, cost } in pairs {
                    let (a, b) = (a as usize, b as usize);
                    merges.push(Pair {
                        a: names[a],
                        b: names[b],
                        cost,
                    });
                    names[b] = names[a];
                }
                for (&name, &to) in names.iter().zip(map) {
                    next[to as usize] = name;
                }
                names = next;
            })?;
        Ok(TilePlan {
            run_of,
            runs,
            merges,
        })
    }

    /// The Gaussians of a partition: `of` has the cluster of each ordered row, or [`GONE`], `count` of them.
    pub fn assemble(
        &self,
        of: Vec<u32>,
        count: usize,
        control: &Control,
    ) -> Result<Outcome<PairwiseRound>> {
        Error::unless_equal("of", of.len(), self.scene.len(), "rows")?;
        let partition = Partition { of, count };
        let blur = self.blurs();
        let step = self
            .policy
            .assembled(&partition, self.scene, self.ordered, &blur, control)?;
        Ok(step.finish(self.scene, self.ordered, vec![false; count], Vec::new()))
    }

    fn blurs(&self) -> Vec<f32> {
        let usual = Some(self.frame.pixel_size);
        self.policy
            .blurs(self.scene, self.ordered, self.visibility, usual)
    }

    /// The rows that a renderer draws; one row at least.
    fn leaves<'b>(&'b self, blur: &'b [f32]) -> Result<Leaves<'b>> {
        self.policy.check(self.scene, self.visibility, None)?;
        let (partition, _) = self.policy.drop_transparent(self.scene, self.ordered, 1);
        Ok(Leaves::new(
            self.scene,
            self.ordered,
            partition.kept(),
            blur,
            self.visibility,
            Some(&self.frame),
        ))
    }

    fn weights(&self) -> Weights {
        self.policy.weights(self.visibility)
    }
}
