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

/// How much a row counts where no view tells: m^a · α^b, in units of the median mass.
///
/// Where all Gaussians are of about one size, or grow with the distance from the middle as those of an unbounded
/// scene do, large ones fill as much of an image as they are large, and a is 1. Where sizes spread for another
/// reason, large ones are plain or hidden, small ones are what is looked at: every one counts alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Importance {
    exponent: f64,
    usual: f64,
}

impl Default for Importance {
    fn default() -> Self {
        Self {
            exponent: 1.0,
            usual: 1.0,
        }
    }
}

/// Standard deviation of ln m: at the first a is 1, at the second 0. Measured: playbot 1.0, taebak 1.4, showroom 1.9,
/// guitar 2.1.
const SPREAD: (f64, f64) = (1.0, 2.0);
/// Correlation of ln A with the logarithm of the distance from the middle, from which on sizes follow it in part,
/// and altogether. Measured: paljassaare 0.6, objects and rooms under 0.15.
const FOLLOWS: (f64, f64) = (0.25, 0.45);
/// b where a is 0: faint layers count a little more than their share.
const FAINT: f64 = -0.4;

impl Importance {
    fn of_scene(nodes: &[Node]) -> Self {
        let shown = || nodes.iter().filter(|n| n.mass > 0.0 && n.alpha > 0.0);
        let radius = |n: &Node| {
            n.mean
                .iter()
                .map(|v| f64::from(*v).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let Some(usual) = median(shown().map(|n| n.mass).collect()) else {
            return Self::default();
        };
        let masses = Moments::of(shown().map(|n| (f64::from(n.mass).ln(), 0.0)));
        let sizes = Moments::of(shown().filter(|n| radius(n) > 0.0).map(|n| {
            let area = f64::from(n.mass) / f64::from(n.alpha);
            (area.ln(), radius(n).ln())
        }));
        let spread = ramp(masses.deviation(), SPREAD);
        let own = 1.0 - ramp(sizes.correlation(), FOLLOWS);
        Self {
            exponent: 1.0 - spread * own,
            usual: f64::from(usual),
        }
    }

    fn of(&self, node: &Node) -> f32 {
        if self.exponent == 1.0 {
            return node.mass;
        }
        let alpha = f64::from(node.alpha).max(f64::MIN_POSITIVE);
        let share = (f64::from(node.mass) / self.usual).powf(self.exponent);
        (self.usual * share * alpha.powf(FAINT * (1.0 - self.exponent))) as f32
    }
}

/// 0 up to the first, 1 from the second on.
fn ramp(value: f64, (from, to): (f64, f64)) -> f64 {
    ((value - from) / (to - from)).clamp(0.0, 1.0)
}

/// Sums of pairs, one after another: their order decides the last bits.
#[derive(Default)]
struct Moments {
    count: f64,
    mean: [f64; 2],
    square: [f64; 2],
    product: f64,
}

impl Moments {
    fn of(pairs: impl Iterator<Item = (f64, f64)>) -> Self {
        pairs.fold(Self::default(), |mut s, (x, y)| {
            s.count += 1.0;
            let (dx, dy) = (x - s.mean[0], y - s.mean[1]);
            s.mean[0] += dx / s.count;
            s.mean[1] += dy / s.count;
            s.square[0] += dx * (x - s.mean[0]);
            s.square[1] += dy * (y - s.mean[1]);
            s.product += dx * (y - s.mean[1]);
            s
        })
    }

    /// Of the first.
    fn deviation(&self) -> f64 {
        (self.square[0] / self.count.max(1.0)).sqrt()
    }

    fn correlation(&self) -> f64 {
        let scale = (self.square[0] * self.square[1]).sqrt();
        if scale > 0.0 {
            self.product / scale
        } else {
            0.0
        }
    }
}

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
    /// What stands for Σ αT without views.
    importance: Importance,
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
            importance: Importance::default(),
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
        } else {
            let nodes: Vec<Node> = (0..leaves.len())
                .into_par_iter()
                .map(|i| leaves.node(i))
                .collect();
            leaves.importance = Importance::of_scene(&nodes);
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
            None => self.importance.of(&node),
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows on a line, `step` apart, of scales that `size` gives.
    fn line(count: usize, size: impl Fn(usize) -> f32) -> Vec<Node> {
        let node = |i: usize| {
            let s = size(i);
            Node {
                mean: [i as f32 + 1.0, 0.0, 0.0],
                cov: [s * s, 0.0, 0.0, s * s, 0.0, 0.01 * s * s],
                alpha: 0.2,
                ..Node::default()
            }
            .weighed()
        };
        (0..count).map(node).collect()
    }

    #[test]
    fn one_size_counts_by_area_a_spread_by_number_and_distance_explains_it() {
        let exponent = |nodes: &[Node]| Importance::of_scene(nodes).exponent;
        assert_eq!(exponent(&line(500, |_| 0.1)), 1.0);
        let spread = line(500, |i| 0.01 * ((i * 7919 % 500) as f32 / 60.0).exp());
        assert_eq!(exponent(&spread), 0.0);
        let growing = line(500, |i| 0.01 * (i as f32 + 1.0));
        assert_eq!(exponent(&growing), 1.0);
        let half = line(500, |i| 0.01 * ((i * 7919 % 500) as f32 / 192.0).exp());
        assert!((0.3..0.7).contains(&exponent(&half)), "{}", exponent(&half));
    }

    #[test]
    fn counted_alike_a_row_weighs_what_the_median_does() {
        let nodes = line(501, |i| 0.01 * ((i * 7919 % 501) as f32 / 60.0).exp());
        let by = Importance::of_scene(&nodes);
        let (low, high) = (by.of(&nodes[0]), by.of(&nodes[500]));
        assert_eq!(low, high);
        assert!((f64::from(low) / by.usual - 0.2f64.powf(FAINT)).abs() < 1e-6);
        assert_eq!(Importance::default().of(&nodes[3]), nodes[3].mass);
    }
}
