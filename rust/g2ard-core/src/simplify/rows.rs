//! What merging starts from: rows that are nodes already, or Gaussians of the scene, made nodes as they are read.

use rayon::prelude::*;

use super::clusters::Partition;
use super::cost::{MAX_ALPHA, Node};
use super::matching::Nodes;
use super::moments::sigmoid;
use super::pairwise::Seen;
use super::{Ordered, SceneRef};

/// Nodes in a fixed order, and their SH.
pub trait Rows: Sync {
    fn len(&self) -> usize;
    /// Values of SH a row.
    fn width(&self) -> usize;
    fn node(&self, i: usize) -> Node;
    /// Band 0.
    fn color(&self, i: usize) -> [f32; 3];
    /// All bands, into `width` values.
    fn read_sh(&self, i: usize, out: &mut [f32]);

    /// Each run of rows as one node.
    fn merged(&self, runs: &Partition) -> Nodes {
        let mut ends: Vec<usize> = (1..runs.of.len())
            .filter(|&i| runs.of[i] != runs.of[i - 1])
            .collect();
        ends.push(runs.of.len());
        let width = self.width();
        let mut sh = vec![0.0; runs.count * width];
        let geometry = sh
            .par_chunks_mut(width)
            .enumerate()
            .map(|(run, out)| {
                let from = if run == 0 { 0 } else { ends[run - 1] };
                let mut node = self.node(from);
                let mut added = [0.0; MAX_WIDTH];
                self.read_sh(from, out);
                for i in from + 1..ends[run] {
                    let next = self.node(i);
                    let share = node.share(&next);
                    self.read_sh(i, &mut added[..width]);
                    out.iter_mut()
                        .zip(&added)
                        .for_each(|(p, q)| *p += share * (q - *p));
                    node = node.merged(&next);
                }
                node
            })
            .collect();
        Nodes {
            geometry,
            sh,
            width,
        }
    }
}

/// SH of degree 3, three channels.
const MAX_WIDTH: usize = 48;

impl Rows for Nodes {
    fn len(&self) -> usize {
        self.geometry.len()
    }

    fn width(&self) -> usize {
        self.width
    }

    fn node(&self, i: usize) -> Node {
        self.geometry[i]
    }

    fn color(&self, i: usize) -> [f32; 3] {
        let at = i * self.width;
        [self.sh[at], self.sh[at + 1], self.sh[at + 2]]
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.sh[i * self.width..(i + 1) * self.width]);
    }
}

/// Nodes in another order than they lie in: at 13 million, to move them would take half the memory of all.
pub struct Shuffled {
    nodes: Nodes,
    at: Vec<u32>,
}

impl Shuffled {
    pub fn new(nodes: Nodes, at: Vec<u32>) -> Self {
        Self { nodes, at }
    }

    /// The nodes, moved to their places.
    pub fn settled(mut self) -> Nodes {
        self.nodes.gather(&self.at);
        self.nodes
    }
}

impl Rows for Shuffled {
    fn len(&self) -> usize {
        self.at.len()
    }

    fn width(&self) -> usize {
        self.nodes.width
    }

    fn node(&self, i: usize) -> Node {
        self.nodes.node(self.at[i] as usize)
    }

    fn color(&self, i: usize) -> [f32; 3] {
        self.nodes.color(self.at[i] as usize)
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        self.nodes.read_sh(self.at[i] as usize, out);
    }
}

/// What a few views do not see counts as if this share of its mass were: other views will see some of it.
const UNSEEN: f32 = 0.2;

/// Largest scale and coordinate in typical sizes: beyond, f32 products of four of them would overflow.
const MAX_SCALE: f64 = 1e6;
const MAX_COORDINATE: f64 = 1e15;

/// Rows of the scene. At 13 million their nodes would take more than the scene itself.
pub struct Leaves<'a> {
    scene: &'a SceneRef<'a>,
    ordered: &'a Ordered,
    /// The ordered rows that are kept, ascending.
    kept: Vec<u32>,
    /// The variance that rendering adds to each ordered row.
    blur: &'a [f32],
    seen: Option<Seen<'a>>,
    /// What the scene's lengths are divided by.
    unit: f64,
    /// Σ αT that a unit of mass counts for though no view sees it.
    floor: f32,
}

impl<'a> Leaves<'a> {
    pub fn new(
        scene: &'a SceneRef<'a>,
        ordered: &'a Ordered,
        kept: Vec<u32>,
        blur: &'a [f32],
        seen: Option<Seen<'a>>,
    ) -> Self {
        let unit = typical_size(scene);
        let mut leaves = Self {
            scene,
            ordered,
            kept,
            blur,
            seen,
            unit,
            floor: 0.0,
        };
        if let Some(seen) = seen {
            let masses: Vec<f32> = (0..leaves.len())
                .into_par_iter()
                .map(|i| leaves.node(i).mass)
                .collect();
            let mass: f64 = masses.iter().map(|&m| f64::from(m)).sum();
            let rows = leaves.kept.iter();
            let total: f64 = rows.map(|&i| f64::from(leaves.weight(seen, i))).sum();
            leaves.floor = UNSEEN
                * if total > 0.0 {
                    (total / mass) as f32
                } else {
                    1.0
                };
        }
        leaves
    }

    /// The ordered rows they are, ascending.
    pub fn kept(&self) -> &[u32] {
        &self.kept
    }

    /// Every row as a node of its own.
    pub fn nodes(&self) -> Nodes {
        let width = self.width();
        let mut sh = vec![0.0; self.len() * width];
        let rows = sh.par_chunks_mut(width).enumerate();
        rows.for_each(|(i, out)| self.read_sh(i, out));
        Nodes {
            geometry: (0..self.len())
                .into_par_iter()
                .map(|i| self.node(i))
                .collect(),
            sh,
            width,
        }
    }

    fn weight(&self, seen: Seen, ordered: u32) -> f32 {
        seen.weight[self.ordered.rows[ordered as usize] as usize].max(0.0)
    }
}

impl Rows for Leaves<'_> {
    fn len(&self) -> usize {
        self.kept.len()
    }

    fn width(&self) -> usize {
        3 * (self.scene.rest + 1)
    }

    fn node(&self, i: usize) -> Node {
        let at = self.kept[i] as usize;
        let row = self.ordered.rows[at] as usize;
        let mut g = self.ordered.gaussian(self.scene, row);
        g.scales = g.scales.map(|s| (s / self.unit).min(MAX_SCALE));
        let coordinate = |v: f64| (v / self.unit).clamp(-MAX_COORDINATE, MAX_COORDINATE) as f32;
        let mut node = Node {
            mean: g.mean.map(coordinate),
            cov: g.covariance().map(|v| v as f32),
            blur: (f64::from(self.blur[at]) / (self.unit * self.unit)) as f32,
            alpha: (sigmoid(f64::from(self.scene.logit(row))) as f32).min(MAX_ALPHA),
            ..Node::default()
        }
        .weighed();
        node.seen = match self.seen {
            Some(seen) => self.weight(seen, at as u32) + self.floor * node.mass,
            None => node.mass,
        };
        node
    }

    fn color(&self, i: usize) -> [f32; 3] {
        self.scene.sh0[self.ordered.rows[self.kept[i] as usize] as usize]
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        let (dc, rest) = self
            .scene
            .sh_of(self.ordered.rows[self.kept[i] as usize] as usize);
        out[..3].copy_from_slice(&dc);
        out[3..].copy_from_slice(rest.as_flattened());
    }
}

/// The middle value; `None` of nothing.
pub fn median(mut values: Vec<f32>) -> Option<f32> {
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
