//! The binary tree of Morton codes, and what merging each of its subtrees into one node costs.
//!
//! Rows sorted by Morton code are the leaves of a binary tree whose inner nodes are common prefixes. An inner
//! node is named by the gap between two neighbouring rows at which it splits, so one number per gap says what
//! merging everything below it costs. That number never falls towards the root: cutting at any threshold
//! leaves whole subtrees, which are contiguous runs of rows.
//!
//! Views that come nearer than those that weigh rows see what costs nothing from afar, such as the letters of a sign.
//! Long runs are therefore dearer than their merges, and none is longer than a limit.

use super::clusters::Partition;
use super::cost::{Node, Weights, color_distance};
use super::rows::Rows;

/// Rows below which a subtree is not worth another task.
const GRAIN: usize = 4096;

/// Cost of a run beyond the limit, for each of its rows: above that of every other run, and finite for 2³² rows.
const TOO_LONG: f32 = 1e28;

/// A subtree merged into one node, its colour, and the sum of its merges' costs.
struct Subtree {
    node: Node,
    color: [f32; 3],
    cost: f32,
}

struct MortonTree<'a, R> {
    codes: &'a [u64],
    rows: &'a R,
    weights: Weights,
    longest: usize,
}

/// For every gap between neighbouring rows, the cost of merging all rows that its tree node spans: the sum of its
/// merges' costs times the root of the number of rows. Runs of more than `longest` rows cost more than all others.
///
/// `codes` ascend; `rows` are in the same order.
pub fn merge_costs(codes: &[u64], rows: &impl Rows, weights: Weights, longest: usize) -> Vec<f32> {
    let mut costs = vec![0.0; rows.len().saturating_sub(1)];
    if !costs.is_empty() {
        let tree = MortonTree {
            codes,
            rows,
            weights,
            longest,
        };
        tree.merge(0, rows.len(), &mut costs);
    }
    costs
}

impl<R: Rows> MortonTree<'_, R> {
    /// Merges rows `from..to`; `costs` has an element for each gap between them.
    fn merge(&self, from: usize, to: usize, costs: &mut [f32]) -> Subtree {
        if to - from == 1 {
            return Subtree {
                node: self.rows.node(from),
                color: self.rows.color(from),
                cost: 0.0,
            };
        }
        let split = self.split(from, to);
        let (left, rest) = costs.split_at_mut(split - from - 1);
        let (gap, right) = rest.split_at_mut(1);
        let (a, b) = if to - from > GRAIN {
            rayon::join(
                || self.merge(from, split, left),
                || self.merge(split, to, right),
            )
        } else {
            (self.merge(from, split, left), self.merge(split, to, right))
        };
        let subtree = self.join(&a, &b);
        let count = (to - from) as f32;
        gap[0] = if to - from > self.longest {
            TOO_LONG * count
        } else {
            (subtree.cost * count.sqrt()).min(TOO_LONG)
        };
        subtree
    }

    /// The first row whose code has the highest bit in which the range's codes differ; the middle of equals.
    fn split(&self, from: usize, to: usize) -> usize {
        let (first, last) = (self.codes[from], self.codes[to - 1]);
        if first == last {
            return from + (to - from) / 2;
        }
        let bit = 63 - (first ^ last).leading_zeros();
        let prefix = last >> bit << bit;
        from + self.codes[from..to].partition_point(|&c| c < prefix)
    }

    fn join(&self, a: &Subtree, b: &Subtree) -> Subtree {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { join_avx2(a, b, self.weights) };
        }
        join(a, b, self.weights)
    }
}

/// The same code with wider registers; no fused operations, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn join_avx2(a: &Subtree, b: &Subtree, weights: Weights) -> Subtree {
    join(a, b, weights)
}

#[inline(always)]
fn join(a: &Subtree, b: &Subtree, weights: Weights) -> Subtree {
    let share = a.node.share(&b.node);
    let node = a.node.merged(&b.node);
    let color = color_distance(&a.color, &b.color);
    let cost = a.node.cost_as(&b.node, &node, color, weights);
    Subtree {
        node,
        color: [0, 1, 2].map(|k| a.color[k] + share * (b.color[k] - a.color[k])),
        cost: (a.cost + b.cost + cost).min(f32::MAX),
    }
}

/// The partition into `count` runs that closes the cheapest gaps, between equals the earlier.
pub fn cut(costs: &[f32], count: usize) -> Partition {
    let rows = costs.len() + 1;
    let close = rows.saturating_sub(count.max(1));
    let mut keys: Vec<(u32, u32)> = costs
        .iter()
        .enumerate()
        .map(|(g, s)| (s.to_bits(), g as u32))
        .collect();
    let mut closed = vec![false; costs.len()];
    if close > 0 {
        keys.select_nth_unstable(close - 1);
        keys[..close]
            .iter()
            .for_each(|k| closed[k.1 as usize] = true);
    }
    let mut of = Vec::with_capacity(rows);
    of.push(0);
    let mut run = 0;
    for closed in closed {
        run += u32::from(!closed);
        of.push(run);
    }
    Partition {
        of,
        count: run as usize + 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simplify::matching::Nodes;

    const WEIGHTS: Weights = Weights {
        geometric: 0.03,
        edge: 3.0,
    };

    fn costs_of(codes: &[u64], rows: &Nodes) -> Vec<f32> {
        merge_costs(codes, rows, WEIGHTS, usize::MAX)
    }

    fn nodes(n: usize) -> Nodes {
        let geometry = (0..n)
            .map(|i| {
                let mut node = Node {
                    mean: [i as f32 + (i / 8 * 20) as f32, 0.0, 0.0],
                    cov: [1.0, 0.0, 0.0, 1.0, 0.0, 0.01],
                    blur: 0.1,
                    alpha: 0.5,
                    ..Node::default()
                }
                .weighed();
                node.visibility = node.mass;
                node
            })
            .collect();
        Nodes {
            geometry,
            sh: vec![0.0; 3 * n],
            width: 3,
        }
    }

    #[test]
    fn any_cut_leaves_whole_subtrees_and_the_exact_count() {
        let codes: Vec<u64> = (0..64).map(|i| i * 3).collect();
        let costs = costs_of(&codes, &nodes(64));
        for count in 1..=64 {
            let p = cut(&costs, count);
            assert_eq!((p.count, p.of.len()), (count, 64));
            assert!(p.of.windows(2).all(|w| w[1] - w[0] <= 1));
        }
        // Groups of eight lie far apart: the cheapest eight clusters are those groups.
        let codes: Vec<u64> = (0..64).collect();
        let p = cut(&costs_of(&codes, &nodes(64)), 8);
        assert!((0..64).all(|i| p.of[i] == i as u32 / 8), "{:?}", p.of);
    }

    #[test]
    fn a_gap_costs_what_all_merges_below_it_do() {
        let (codes, rows) = ((0..16).collect::<Vec<u64>>(), nodes(16));
        let costs = costs_of(&codes, &rows);
        // The trailing zeros of a gap's number say how many rows it joins.
        let rows_of = |gap: usize| (2u32 << (gap + 1).trailing_zeros()) as f32;
        let costs: Vec<f32> = costs
            .iter()
            .enumerate()
            .map(|(gap, cost)| cost / rows_of(gap).sqrt())
            .collect();
        let (left, right) = (&costs[..7], &costs[8..]);
        let alike = |a: f32, b: f32| (a - b).abs() <= 1e-5 * b;
        let pair = costs[0];
        assert!(
            pair > 0.0 && left.iter().step_by(2).all(|&c| alike(c, pair)),
            "{costs:?}"
        );
        for four in [left[1], left[5], right[1]] {
            assert!(four > 2.0 * pair);
        }
        assert!(left[3] > left[1] + left[5] && alike(left[3], right[3]));
        assert!(costs[7] > left[3] + right[3]);
        assert_eq!(costs.iter().copied().fold(0.0, f32::max), costs[7]);
    }

    #[test]
    fn one_place_and_one_row() {
        assert_eq!(cut(&costs_of(&[5; 9], &nodes(9)), 4).count, 4);
        assert_eq!(cut(&costs_of(&[5], &nodes(1)), 1).count, 1);
    }

    #[test]
    fn no_run_is_longer_than_the_limit_while_shorter_ones_suffice() {
        // Half of the rows no view sees: all of them would merge for nothing.
        let mut rows = nodes(64);
        for (i, node) in rows.geometry.iter_mut().enumerate() {
            node.visibility *= if i < 32 { 0.0 } else { 1.0 };
        }
        let codes: Vec<u64> = (0..64).collect();
        let longest_of = |count: usize, limit: usize| {
            let p = cut(&merge_costs(&codes, &rows, WEIGHTS, limit), count);
            assert_eq!(p.count, count);
            p.of.chunk_by(|a, b| a == b).map(<[u32]>::len).max()
        };
        assert_eq!(longest_of(33, usize::MAX), Some(32));
        assert_eq!(longest_of(33, 8), Some(8));
        assert_eq!(longest_of(8, 8), Some(8));
        // The count comes first.
        assert!(longest_of(7, 8) > Some(8));
        assert_eq!(longest_of(4, 8), Some(16));
        assert_eq!(longest_of(1, 8), Some(64));
    }

    #[test]
    fn four_rows_cost_twice_the_sum_of_their_merges() {
        let mut rows = nodes(4);
        for (i, node) in rows.geometry.iter_mut().enumerate() {
            node.alpha = [0.1, 0.4, 0.3, 0.9][i];
            *node = node.weighed();
            node.visibility = 1.0 + i as f32;
        }
        rows.sh = (0..12).map(|i| (i * i % 7) as f32 / 7.0).collect();
        let merge = |(a, p): (Node, [f32; 3]), (b, q): (Node, [f32; 3])| {
            let (m, share) = (a.merged(&b), b.mass / (a.mass + b.mass));
            let color = [0, 1, 2].map(|k| p[k] * (1.0 - share) + q[k] * share);
            (a.cost(&b, color_distance(&p, &q), WEIGHTS), (m, color))
        };
        let row = |i: usize| (rows.node(i), rows.color(i));
        let ((first, left), (last, right)) = (merge(row(0), row(1)), merge(row(2), row(3)));
        let sum = first + last + merge(left, right).0;
        let want = [first * 2f32.sqrt(), 2.0 * sum, last * 2f32.sqrt()];
        for (got, want) in costs_of(&[0, 1, 2, 3], &rows).into_iter().zip(want) {
            assert!((got - want).abs() < 1e-5 * want, "{got} {want}");
        }
    }
}
