//! The default policy: pairs of neighbours, cheapest first, in rounds that lock what they merge.
//!
//! The rounds only decide *which* rows go together, in f32 and in units of the scene's typical size; what
//! comes out is made in f64 from the raw members of each cluster ([`Partition::assemble`]).

use rayon::prelude::*;

use super::clusters::Partition;
use super::cost::{MAX_ALPHA, Node};
use super::ladder::{climb, cut};
use super::matching::{Nodes, candidates, matched};
use super::moments::sigmoid;
use super::trim::best;
use super::{GONE, Ordered, Outcome, SceneRef};
use crate::{Control, Error, Result};

/// Defaults are what measured best (docs/decisions.md).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pairwise {
    /// Below this α a Gaussian is dropped: no renderer draws it.
    pub min_opacity: f64,
    /// Down to this many times the budget, rows merge along Morton order alone; infinite for never.
    pub ladder: f64,
    /// In so many steps, each but the first halving the count on a lattice that lies elsewhere.
    pub ladder_steps: usize,
    /// Nearest clusters that one may merge with.
    pub neighbors: usize,
    /// Weight of the geometric error beside that of colour.
    pub geometric: f64,
    /// Standard deviation of the blur that renderers add, in pixels.
    pub dilation: f64,
    /// Without views: size of a pixel over the median largest scale.
    pub pixel_scale: f64,
    /// How much larger than its moments say a cluster may be, in area, where α alone cannot hold its mass.
    pub growth: f64,
}

impl Default for Pairwise {
    fn default() -> Self {
        Self {
            min_opacity: 0.004,
            ladder: 3.0,
            ladder_steps: 1,
            neighbors: 6,
            geometric: 0.03,
            dilation: 0.4,
            pixel_scale: 0.5,
            growth: 1.5,
        }
    }
}

/// What views say of each row.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// Σ αT over the pixels of the views.
    pub weight: &'a [f32],
    /// Size of a pixel at the row, scene units; infinite where no view sees it.
    pub pixel: &'a [f32],
}

/// What one round did, in rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PairwiseRound {
    pub before: usize,
    pub dropped: usize,
    pub merged: usize,
    pub after: usize,
}

/// What a few views do not see counts as if this share of its mass were: other views will see some of it.
const UNSEEN: f32 = 0.2;

/// Largest scale and coordinate in typical sizes: beyond, f32 products of four of them would overflow.
const MAX_SCALE: f64 = 1e6;
const MAX_COORDINATE: f64 = 1e15;

impl Pairwise {
    pub fn run(
        &self,
        scene: &SceneRef,
        seen: Option<Seen>,
        flags: Option<&[bool]>,
        schedule: &[usize],
        control: &Control,
    ) -> Result<Outcome<PairwiseRound>> {
        let ordered = Ordered::new(scene)?;
        self.check(scene, seen, flags)?;
        let flags = flags.map_or_else(|| vec![false; scene.len()], |f| ordered.sorted(f));
        let blur = self.blurs(scene, &ordered, seen);
        let budget = schedule.last().copied().unwrap_or(scene.len());
        control.begin(scene.len().saturating_sub(budget) as u64);
        let (mut partition, dropped) = self.visible(scene, &ordered, budget);
        let mut nodes = self.nodes(scene, &ordered, &partition, &blur, seen);
        let mut rounds = Vec::new();
        self.climb(&ordered, &mut partition, &mut nodes, budget, &mut rounds);
        for &target in schedule {
            while nodes.len() > target {
                let before = nodes.len();
                let lists = candidates(&nodes, self.neighbors, self.geometric as f32, control)?;
                let pairs = matched(&lists, self.neighbors, before - target);
                drop(lists);
                let map = merge(&mut nodes, &pairs);
                let of = partition.of.par_iter_mut().filter(|c| **c != GONE);
                of.for_each(|c| *c = map[*c as usize]);
                rounds.push(PairwiseRound {
                    before,
                    merged: pairs.len(),
                    after: nodes.len(),
                    ..PairwiseRound::default()
                });
                control.advance(pairs.len() as u64);
            }
        }
        if let Some(first) = rounds.first_mut() {
            first.before += dropped;
            first.dropped = dropped;
        }
        partition.count = nodes.len();
        drop(nodes);
        let (step, clamped) = partition.assemble(
            scene,
            &ordered,
            &flags,
            self.growth,
            |i| blur[i].into(),
            control,
        )?;
        let mut outcome = step.finish(scene, &ordered, rounds);
        outcome.clamped_opacities = clamped;
        Ok(outcome)
    }

    /// Merges runs of Morton order down to `ladder` times the budget. Each time the lattice lies
    /// elsewhere, so that what one cut apart the next may join.
    fn climb(
        &self,
        ordered: &Ordered,
        partition: &mut Partition,
        nodes: &mut Nodes,
        budget: usize,
        rounds: &mut Vec<PairwiseRound>,
    ) {
        let last = (self.ladder * budget as f64).min(nodes.len() as f64) as usize;
        let kept = ordered
            .codes
            .iter()
            .zip(&partition.of)
            .filter(|(_, c)| **c != GONE);
        let mut codes: Vec<u64> = kept.map(|(&code, _)| code).collect();
        for step in (0..self.ladder_steps).rev() {
            let target = last.saturating_mul(1 << step.min(32));
            if target >= nodes.len() {
                continue;
            }
            let spent = climb(
                &codes,
                &nodes.geometry,
                &nodes.sh,
                nodes.width,
                self.geometric as f32,
            );
            let runs = cut(&spent, target);
            rounds.push(PairwiseRound {
                before: nodes.len(),
                merged: nodes.len() - runs.count,
                after: runs.count,
                ..PairwiseRound::default()
            });
            nodes.merge_runs(&runs);
            let (map, new) = nodes.sort(LATTICES[step % LATTICES.len()]);
            codes = new;
            let of = partition.of.par_iter_mut().filter(|c| **c != GONE);
            of.for_each(|c| *c = map[runs.of[*c as usize] as usize]);
        }
    }

    fn check(&self, scene: &SceneRef, seen: Option<Seen>, flags: Option<&[bool]>) -> Result<()> {
        let lengths = [
            ("visibility.weight", seen.map(|s| s.weight.len())),
            ("visibility.pixel_size", seen.map(|s| s.pixel.len())),
            ("protected", flags.map(<[bool]>::len)),
        ];
        for (name, rows) in lengths {
            if let Some(rows) = rows.filter(|&rows| rows != scene.len()) {
                return Err(Error::invalid(name, format!("{} rows", scene.len()), rows));
            }
        }
        if self.neighbors == 0 {
            return Err(Error::invalid("neighbors", "at least 1", 0));
        }
        for (name, value) in [("ladder", self.ladder), ("max_growth", self.growth)] {
            if value.is_nan() || value < 1.0 {
                return Err(Error::invalid(name, "at least 1", value));
            }
        }
        Ok(())
    }

    /// The variance that rendering adds to each ordered row.
    fn blurs(&self, scene: &SceneRef, ordered: &Ordered, seen: Option<Seen>) -> Vec<f32> {
        let pixel = seen.map_or_else(Vec::new, |s| ordered.sorted(s.pixel));
        let finite = pixel.iter().copied().filter(|p| p.is_finite() && *p > 0.0);
        let usual = median(finite.collect()).unwrap_or_else(|| {
            let largest = scene
                .scales
                .iter()
                .map(|s| s[0].max(s[1]).max(s[2]))
                .collect();
            self.pixel_scale as f32 * median(largest).unwrap_or(1.0)
        });
        let of = |i: usize| {
            let p = pixel
                .get(i)
                .copied()
                .filter(|p| p.is_finite() && *p > 0.0)
                .unwrap_or(usual);
            let e = self.dilation * f64::from(p);
            (e * e) as f32
        };
        (0..scene.len()).into_par_iter().map(of).collect()
    }

    /// Every row that can be seen a cluster of its own; if those are fewer than the budget, the most opaque
    /// of the others too.
    fn visible(&self, scene: &SceneRef, ordered: &Ordered, budget: usize) -> (Partition, usize) {
        let opacity = |&row: &u32| sigmoid(f64::from(scene.logit(row as usize)));
        let mut scores: Vec<f64> = ordered.rows.par_iter().map(opacity).collect();
        scores
            .par_iter_mut()
            .filter(|a| **a >= self.min_opacity)
            .for_each(|a| *a = 1.0);
        let visible = scores.iter().filter(|a| **a == 1.0).count();
        let keep = best(&scores, visible.max(budget.min(scores.len())));
        let mut of = vec![GONE; scores.len()];
        keep.iter()
            .enumerate()
            .for_each(|(c, &i)| of[i as usize] = c as u32);
        let count = keep.len();
        (Partition { of, count }, scores.len() - count)
    }

    fn nodes(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        kept: &Partition,
        blur: &[f32],
        seen: Option<Seen>,
    ) -> Nodes {
        let unit = typical_size(scene);
        let rows: Vec<u32> = (0..scene.len() as u32)
            .filter(|&i| kept.of[i as usize] != GONE)
            .collect();
        let mut geometry: Vec<Node> = rows
            .par_iter()
            .map(|&i| {
                node(
                    scene,
                    ordered,
                    i as usize,
                    unit,
                    f64::from(blur[i as usize]),
                )
            })
            .collect();
        if let Some(seen) = seen {
            let weight = |i: u32| seen.weight[ordered.rows[i as usize] as usize].max(0.0);
            let total: f64 = rows.iter().map(|&i| f64::from(weight(i))).sum();
            let mass: f64 = geometry.iter().map(|n| f64::from(n.mass)).sum();
            let floor = UNSEEN
                * if total > 0.0 {
                    (total / mass) as f32
                } else {
                    1.0
                };
            geometry
                .par_iter_mut()
                .zip(&rows)
                .for_each(|(n, &i)| n.seen = weight(i) + floor * n.mass);
        }
        let width = 3 * (scene.rest + 1);
        let mut sh = vec![0.0; rows.len() * width];
        sh.par_chunks_mut(width).zip(&rows).for_each(|(out, &i)| {
            let (dc, rest) = scene.sh_of(ordered.rows[i as usize] as usize);
            out[..3].copy_from_slice(&dc);
            out[3..].copy_from_slice(rest.as_flattened());
        });
        Nodes {
            geometry,
            sh,
            width,
        }
    }
}

fn median(mut values: Vec<f32>) -> Option<f32> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// A power of two near the median of the middle scale, so that dividing by it rounds nothing.
fn typical_size(scene: &SceneRef) -> f64 {
    let middle = |s: &[f32; 3]| s[0].max(s[1]).min(s[2]).max(s[0].min(s[1]));
    let positive = scene
        .scales
        .iter()
        .map(middle)
        .filter(|s| *s > 0.0)
        .collect();
    let size = f64::from(median(positive).unwrap_or(1.0));
    f64::from_bits(size.to_bits() & (0x7ff << 52))
}

fn node(scene: &SceneRef, ordered: &Ordered, i: usize, unit: f64, blur: f64) -> Node {
    let row = ordered.rows[i] as usize;
    let mut g = ordered.gaussian(scene, row);
    g.scales = g.scales.map(|s| (s / unit).min(MAX_SCALE));
    let mut node = Node {
        mean: g
            .mean
            .map(|v| (v / unit).clamp(-MAX_COORDINATE, MAX_COORDINATE) as f32),
        cov: g.covariance().map(|v| v as f32),
        blur: (blur / (unit * unit)) as f32,
        alpha: (sigmoid(f64::from(scene.logit(row))) as f32).min(MAX_ALPHA),
        ..Node::default()
    }
    .weighed();
    node.seen = node.mass;
    node
}

/// Merges the pairs and puts the nodes that are left in Morton order. Returns where each node went.
fn merge(nodes: &mut Nodes, pairs: &[(u32, u32)]) -> Vec<u32> {
    let width = nodes.width;
    let mut into = vec![GONE; nodes.len()];
    for &(a, b) in pairs {
        let (x, y) = (nodes.geometry[a as usize], nodes.geometry[b as usize]);
        nodes.geometry[a as usize] = x.merged(&y);
        let share = x.share(&y);
        let (low, high) = nodes.sh.split_at_mut(b as usize * width);
        let own = &mut low[a as usize * width..(a as usize + 1) * width];
        own.iter_mut()
            .zip(&high[..width])
            .for_each(|(p, q)| *p += share * (q - *p));
        into[b as usize] = a;
    }
    let left: Vec<u32> = (0..nodes.len() as u32)
        .filter(|&i| into[i as usize] == GONE)
        .collect();
    let (mut map, _) = nodes.pick(&left, [0.0; 3]);
    for i in 0..into.len() {
        if into[i] != GONE {
            map[i] = map[into[i] as usize];
        }
    }
    map
}

/// Where the lattice lies, in shares of the frame's radius.
const LATTICES: [[f64; 3]; 3] = [[0.0; 3], [0.31, 0.17, 0.43], [0.13, 0.41, 0.23]];
