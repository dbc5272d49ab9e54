//! The pairs that merge in one round: cheapest neighbours first, each row once.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use rayon::prelude::*;

use super::GONE;
use super::cost::{Node, color_distance};
use crate::spatial::{RobustBounds, Tree, codes, order};
use crate::{Control, Result};

/// Clusters in Morton order, with their SH, `width` values each.
#[derive(Debug, Clone, Default)]
pub struct Nodes {
    pub geometry: Vec<Node>,
    pub sh: Vec<f32>,
    pub width: usize,
}

impl Nodes {
    pub fn len(&self) -> usize {
        self.geometry.len()
    }

    /// The rows of `left` in Morton order on a lattice shifted by shares of the bounds's radius, where each node
    /// then is ([`GONE`] if not in `left`), and the codes in that order.
    pub fn morton(&self, left: &[u32], shift: [f64; 3]) -> (Vec<u32>, Vec<u32>, Vec<u64>) {
        let means: Vec<[f64; 3]> = left
            .par_iter()
            .map(|&i| self.geometry[i as usize].mean.map(f64::from))
            .collect();
        let mut bounds = RobustBounds::of(&means);
        (0..3).for_each(|k| bounds.origin[k] += shift[k] * bounds.radius);
        let keys = codes(&means, &bounds);
        let sorted = order(&keys);
        let from: Vec<u32> = sorted.par_iter().map(|&at| left[at as usize]).collect();
        let mut map = vec![GONE; self.len()];
        from.iter()
            .enumerate()
            .for_each(|(to, &i)| map[i as usize] = to as u32);
        let keys = sorted.par_iter().map(|&at| keys[at as usize]).collect();
        (from, map, keys)
    }

    /// Keeps the nodes `from`, in that order.
    pub fn gather(&mut self, from: &[u32]) {
        let width = self.width;
        let mut sh = vec![0.0; from.len() * width];
        let rows = sh.par_chunks_mut(width).zip(from);
        rows.for_each(|(out, &i)| out.copy_from_slice(self.sh_of(i as usize)));
        self.geometry = from
            .par_iter()
            .map(|&i| self.geometry[i as usize])
            .collect();
        self.sh = sh;
    }

    fn sh_of(&self, i: usize) -> &[f32] {
        &self.sh[i * self.width..(i + 1) * self.width]
    }

    #[inline(always)]
    fn cost(&self, i: usize, j: usize, geometric: f32) -> f32 {
        let (i, j) = (i.min(j), i.max(j)); // the same rounding for (i, j) and (j, i)
        let color = color_distance(self.sh_of(i), self.sh_of(j));
        self.geometry[i].cost(&self.geometry[j], color, geometric)
    }

    /// Costs of `i` against each of `near`.
    fn costs(&self, i: usize, near: &[(f32, u32)], geometric: f32, out: &mut [Candidate]) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.costs_avx2(i, near, geometric, out) };
        }
        self.costs_any(i, near, geometric, out);
    }

    /// The same code with wider registers; no fused operations, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn costs_avx2(&self, i: usize, near: &[(f32, u32)], geometric: f32, out: &mut [Candidate]) {
        self.costs_any(i, near, geometric, out);
    }

    #[inline(always)]
    fn costs_any(&self, i: usize, near: &[(f32, u32)], geometric: f32, out: &mut [Candidate]) {
        for (candidate, &(_, j)) in out.iter_mut().zip(near) {
            *candidate = (self.cost(i, j as usize, geometric), j);
        }
    }
}

/// Cost and partner.
type Candidate = (f32, u32);

const NONE: Candidate = (f32::INFINITY, GONE);
const CHUNK: usize = 1024;

/// The `k` nearest of every node, cheapest to merge with first.
pub fn candidates(
    nodes: &Nodes,
    k: usize,
    geometric: f32,
    control: &Control,
) -> Result<Vec<Candidate>> {
    let tree: Tree<f32> = Tree::over((0..nodes.len() as u32).collect(), |i| {
        nodes.geometry[i].mean
    });
    let mut lists = vec![NONE; nodes.len() * k];
    lists
        .par_chunks_mut(CHUNK * k)
        .enumerate()
        .try_for_each(|(chunk, lists)| {
            control.check()?;
            let mut near = Vec::with_capacity(k);
            for (at, list) in lists.chunks_mut(k).enumerate() {
                let i = chunk * CHUNK + at;
                tree.nearest(i, k, &mut near);
                if near.last().is_some_and(|last| last.0 == 0.0) {
                    spread_duplicates(i, k, nodes.len(), &mut near);
                }
                nodes.costs(i, &near, geometric, list);
                list.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            }
            Ok(())
        })?;
    Ok(lists)
}

/// Among many nodes at one position the nearest by index would be the same few for all of them, and a round could
/// merge only those few: take the next in order instead.
fn spread_duplicates(i: usize, k: usize, n: usize, near: &mut Vec<(f32, u32)>) {
    near.clear();
    let first = i.saturating_sub(k / 2).min(n.saturating_sub(k + 1));
    near.extend(
        (first..n)
            .filter(|&j| j != i)
            .take(k)
            .map(|j| (0.0, j as u32)),
    );
}

/// Up to `merges` disjoint pairs (lower index first), cheapest first, between equals the lower index.
///
/// A row whose partner is taken falls back on its next candidate. Merged rows are locked: otherwise the cheapest
/// cluster would absorb its surroundings.
pub fn matched(lists: &[Candidate], k: usize, merges: usize) -> Vec<(u32, u32)> {
    let n = lists.len() / k;
    // Costs are ≥ 0, so their bits sort as they do.
    let mut best: Vec<(u32, u32)> = (0..n)
        .into_par_iter()
        .map(|i| (lists[i * k].0.to_bits(), i as u32))
        .collect();
    best.par_sort_unstable();
    let mut fallbacks: BinaryHeap<Reverse<(u32, u32, u32)>> = BinaryHeap::new();
    let mut locked = vec![false; n];
    let mut pairs = Vec::with_capacity(merges);
    let mut fresh = best.into_iter().map(|(cost, i)| (cost, i, 0)).peekable();
    while pairs.len() < merges {
        let again = match (fresh.peek(), fallbacks.peek()) {
            (Some(a), Some(Reverse(b))) => b < a,
            (None, None) => break,
            (None, _) => true,
            _ => false,
        };
        let next = if again {
            fallbacks.pop().map(|r| r.0)
        } else {
            fresh.next()
        };
        let Some((_, i, at)) = next else { break };
        let list = &lists[i as usize * k..(i as usize + 1) * k];
        let partner = list[at as usize].1;
        if locked[i as usize] || partner == GONE {
            continue;
        }
        if !locked[partner as usize] {
            locked[i as usize] = true;
            locked[partner as usize] = true;
            pairs.push((i.min(partner), i.max(partner)));
            continue;
        }
        let free = |c: &Candidate| c.1 != GONE && !locked[c.1 as usize];
        if let Some(skip) = list[at as usize + 1..].iter().position(free) {
            let at = at + 1 + skip as u32;
            fallbacks.push(Reverse((list[at as usize].0.to_bits(), i, at)));
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    #[test]
    fn takes_the_cheapest_disjoint_pairs_and_falls_back() {
        // 0–1 costs 1, 1–2 costs 2, 2–3 costs 5, 3–4 costs 3.
        let lists = [
            (1.0, 1),
            NONE,
            (1.0, 0),
            (2.0, 2),
            (2.0, 1),
            (5.0, 3),
            (3.0, 4),
            (5.0, 2),
            (3.0, 3),
            NONE,
        ];
        assert_eq!(matched(&lists, 2, 9), [(0, 1), (3, 4)]);
        assert_eq!(matched(&lists, 2, 1), [(0, 1)]);
        let lists = [
            (1.0, 1),
            NONE,
            (1.0, 0),
            (2.0, 2),
            (2.0, 1),
            (5.0, 3),
            (5.0, 2),
            NONE,
        ];
        assert_eq!(matched(&lists, 2, 9), [(0, 1), (2, 3)]);
    }

    #[test]
    fn equals_the_naive_greedy_matching() {
        let mut random = Lcg(3);
        let mut next = || random.integer();
        let (n, k) = (300, 5);
        let mut lists = vec![NONE; n * k];
        for i in 0..n {
            for at in 0..k {
                let j = next() as usize % n;
                if j != i {
                    lists[i * k + at] = ((next() % 64) as f32, j as u32);
                }
            }
            lists[i * k..(i + 1) * k].sort_by(|a, b| a.partial_cmp(b).unwrap());
        }
        let mut edges: Vec<(f32, usize, usize, u32)> = (0..n * k)
            .filter(|e| lists[*e].1 != GONE)
            .map(|e| (lists[e].0, e / k, e % k, lists[e].1))
            .collect();
        edges.sort_by(|a, b| a.partial_cmp(b).unwrap());
        let (mut locked, mut want) = (vec![false; n], Vec::new());
        for (_, i, _, j) in edges {
            if !locked[i] && !locked[j as usize] {
                locked[i] = true;
                locked[j as usize] = true;
                want.push(((i as u32).min(j), (i as u32).max(j)));
            }
        }
        assert_eq!(matched(&lists, k, n), want);
    }
}
