//! Merging along Morton order, all the way up at once: what each step would cost.
//!
//! Rows sorted by Morton code are the leaves of a binary tree whose inner nodes are common prefixes. An inner
//! node is named by the gap between two neighbouring rows at which it splits, so one number per gap says what
//! merging everything below it has cost. That number never falls on the way up: cutting at any threshold
//! leaves whole subtrees, which are contiguous runs of rows.

use super::clusters::Partition;
use super::cost::{Node, color_distance};
use super::rows::Rows;

/// Rows below which a subtree is not worth another task.
const GRAIN: usize = 4096;

/// A subtree as one cluster, the colour it has, and what merging it has cost.
struct Rung {
    node: Node,
    color: [f32; 3],
    spent: f32,
}

struct Ladder<'a, R> {
    codes: &'a [u64],
    rows: &'a R,
    geometric: f32,
}

/// For every gap between neighbouring rows, the error of merging all that its tree node spans.
///
/// `codes` ascend; `rows` are in the same order.
pub fn climb(codes: &[u64], rows: &impl Rows, geometric: f32) -> Vec<f32> {
    let mut spent = vec![0.0; rows.len().saturating_sub(1)];
    if !spent.is_empty() {
        let ladder = Ladder {
            codes,
            rows,
            geometric,
        };
        ladder.climb(0, rows.len(), &mut spent);
    }
    spent
}

impl<R: Rows> Ladder<'_, R> {
    /// Rows `from..to`; `spent` holds their inner gaps.
    fn climb(&self, from: usize, to: usize, spent: &mut [f32]) -> Rung {
        if to - from == 1 {
            return Rung {
                node: self.rows.node(from),
                color: self.rows.color(from),
                spent: 0.0,
            };
        }
        let split = self.split(from, to);
        let (left, rest) = spent.split_at_mut(split - from - 1);
        let (gap, right) = rest.split_at_mut(1);
        let (a, b) = if to - from > GRAIN {
            rayon::join(
                || self.climb(from, split, left),
                || self.climb(split, to, right),
            )
        } else {
            (self.climb(from, split, left), self.climb(split, to, right))
        };
        let rung = self.join(&a, &b);
        gap[0] = rung.spent;
        rung
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

    fn join(&self, a: &Rung, b: &Rung) -> Rung {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { join_avx2(a, b, self.geometric) };
        }
        join(a, b, self.geometric)
    }
}

/// The same code with wider registers; no fused operations, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn join_avx2(a: &Rung, b: &Rung, geometric: f32) -> Rung {
    join(a, b, geometric)
}

#[inline(always)]
fn join(a: &Rung, b: &Rung, geometric: f32) -> Rung {
    let share = a.node.share(&b.node);
    let node = a.node.merged(&b.node);
    let color = color_distance(&a.color, &b.color);
    let cost = a.node.cost_as(&b.node, &node, color, geometric);
    Rung {
        node,
        color: [0, 1, 2].map(|k| a.color[k] + share * (b.color[k] - a.color[k])),
        spent: (a.spent + b.spent + cost).min(f32::MAX),
    }
}

/// The partition into `count` runs that closes the cheapest gaps, between equals the earlier.
pub fn cut(spent: &[f32], count: usize) -> Partition {
    let rows = spent.len() + 1;
    let close = rows.saturating_sub(count.max(1));
    let mut keys: Vec<(u32, u32)> = spent
        .iter()
        .enumerate()
        .map(|(g, s)| (s.to_bits(), g as u32))
        .collect();
    let mut closed = vec![false; spent.len()];
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
                node.seen = node.mass;
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
        let spent = climb(&codes, &nodes(64), 0.03);
        for count in 1..=64 {
            let p = cut(&spent, count);
            assert_eq!((p.count, p.of.len()), (count, 64));
            assert!(p.of.windows(2).all(|w| w[1] - w[0] <= 1));
        }
        // Groups of eight lie far apart: the cheapest eight clusters are those groups.
        let codes: Vec<u64> = (0..64).collect();
        let p = cut(&climb(&codes, &nodes(64), 0.03), 8);
        assert!((0..64).all(|i| p.of[i] == i as u32 / 8), "{:?}", p.of);
    }

    #[test]
    fn one_place_and_one_row() {
        assert_eq!(cut(&climb(&[5; 9], &nodes(9), 0.03), 4).count, 4);
        assert_eq!(cut(&climb(&[5], &nodes(1), 0.03), 1).count, 1);
    }
}
