//! The pairs that merge in one round: cheapest neighbours first, each row once.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use rayon::prelude::*;

use super::GONE;
use super::clusters::Pair;
use super::cost::{Node, Weights, color_distance};
use crate::raster::simd::{Isa, Kernel, LANES, Lanes, Lanes16, dispatch};
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
}

/// Cost and partner.
type Candidate = (f32, u32);

const NONE: Candidate = (f32::INFINITY, GONE);
const CHUNK: usize = 1024;

/// Fills in what merging each node from `first` on with each of its `k` partners costs, sixteen pairs at a time.
struct PairCosts<'a> {
    nodes: &'a Nodes,
    first: usize,
    k: usize,
    weights: Weights,
    lists: &'a mut [Candidate],
}

/// Values of a node that a cost reads: mean, covariance, dilation, α, mass, visibility, areas.
const VALUES: usize = 19;

impl Kernel for PairCosts<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let mut values = [[Lanes16::default(); VALUES]; 2];
        let mut color = Lanes16::default();
        for start in (0..self.lists.len()).step_by(LANES) {
            let pairs = LANES.min(self.lists.len() - start);
            for l in 0..pairs {
                let i = self.first + (start + l) / self.k;
                let j = match self.lists[start + l].1 {
                    GONE => i,
                    j => j as usize,
                };
                let (i, j) = (i.min(j), i.max(j)); // the same rounding for (i, j) and (j, i)
                self.nodes.geometry[i].write_lane(&mut values[0], l);
                self.nodes.geometry[j].write_lane(&mut values[1], l);
                color.0[l] = color_distance(self.nodes.sh_of(i), self.nodes.sh_of(j));
            }
            let (a, b) = (Node::<F>::read(&values[0]), Node::<F>::read(&values[1]));
            let mut costs = Lanes16::default();
            a.cost(&b, F::load(&color), self.weights.splat())
                .store(&mut costs);
            for (candidate, cost) in self.lists[start..start + pairs].iter_mut().zip(costs.0) {
                if candidate.1 != GONE {
                    candidate.0 = cost;
                }
            }
        }
    }
}

impl Node {
    /// Writes the node to one lane of `values`, in the order of [`VALUES`].
    #[inline(always)]
    fn write_lane(&self, values: &mut [Lanes16; VALUES], lane: usize) {
        let Self {
            mean, cov, areas, ..
        } = self;
        for k in 0..3 {
            values[k].0[lane] = mean[k];
        }
        for k in 0..6 {
            values[3 + k].0[lane] = cov[k];
            values[13 + k].0[lane] = areas[k];
        }
        values[9].0[lane] = self.blur;
        values[10].0[lane] = self.alpha;
        values[11].0[lane] = self.mass;
        values[12].0[lane] = self.visibility;
    }
}

impl<F: Lanes> Node<F> {
    /// Reads sixteen nodes as [`Node::write_lane`] wrote them.
    #[inline(always)]
    fn read(values: &[Lanes16; VALUES]) -> Self {
        let mut node = Self {
            mean: [F::zero(); 3],
            cov: [F::zero(); 6],
            blur: F::load(&values[9]),
            alpha: F::load(&values[10]),
            mass: F::load(&values[11]),
            visibility: F::load(&values[12]),
            areas: [F::zero(); 8],
        };
        for k in 0..3 {
            node.mean[k] = F::load(&values[k]);
        }
        for k in 0..6 {
            node.cov[k] = F::load(&values[3 + k]);
            node.areas[k] = F::load(&values[13 + k]);
        }
        node
    }
}

/// The `k` nearest of every node, cheapest to merge with first.
pub fn candidates(
    nodes: &Nodes,
    k: usize,
    weights: Weights,
    control: &Control,
) -> Result<Vec<Candidate>> {
    let tree: Tree<f32> = Tree::over((0..nodes.len() as u32).collect(), |i| {
        nodes.geometry[i].mean
    });
    let isa = Isa::detect();
    let mut lists = vec![NONE; nodes.len() * k];
    lists
        .par_chunks_mut(CHUNK * k)
        .enumerate()
        .with_max_len(1)
        .try_for_each(|(chunk, lists)| {
            control.check()?;
            let first = chunk * CHUNK;
            tree.nearest(first..first + lists.len() / k, k, |i, near| {
                if near.last().is_some_and(|last| last.0 == 0.0) {
                    spread_duplicates(i, k, nodes.len(), near);
                }
                let list = &mut lists[(i - first) * k..][..k];
                for (candidate, &mut (_, j)) in list.iter_mut().zip(near) {
                    candidate.1 = j;
                }
            });
            let costs = PairCosts {
                nodes,
                first,
                k,
                weights,
                lists,
            };
            dispatch(isa, costs);
            for list in lists.chunks_mut(k) {
                list.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            }
            Ok(())
        })?;
    Ok(lists)
}

/// Among many nodes at one position the nearest by index would be the same few for all of them, and a round could merge
/// only those few. Take the next in order instead.
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

/// Up to `merges` disjoint pairs, cheapest first, between equals the lower index.
///
/// A row whose partner is taken falls back on its next candidate. Merged rows are locked: otherwise the cheapest
/// cluster would absorb its surroundings.
pub fn matched(lists: &[Candidate], k: usize, merges: usize) -> Vec<Pair> {
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
        let (cost, partner) = list[at as usize];
        if locked[i as usize] || partner == GONE {
            continue;
        }
        if !locked[partner as usize] {
            locked[i as usize] = true;
            locked[partner as usize] = true;
            pairs.push(Pair {
                a: i.min(partner),
                b: i.max(partner),
                cost,
            });
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

    const WEIGHTS: Weights = Weights {
        geometric: 0.03,
        edge: 3.0,
    };

    #[test]
    fn sixteen_pairs_cost_what_each_does_alone_to_the_bit() {
        let mut random = Lcg(5);
        let mut next = || random.centred() as f32;
        let geometry: Vec<Node> = (0..101)
            .map(|i| Node {
                mean: [next(), next(), next()].map(|v| v * 10f32.powi(i % 9)),
                cov: [1.0, 0.3 * next(), 0.3 * next(), 1.0, 0.3 * next(), 0.7],
                blur: 0.1,
                alpha: if i % 5 == 0 {
                    0.001
                } else {
                    0.5 + 0.9 * next()
                },
                visibility: 3.0,
                ..Node::default()
            })
            .map(Node::weighed)
            .collect();
        let nodes = Nodes {
            sh: (0..6 * geometry.len()).map(|_| next()).collect(),
            geometry,
            width: 6,
        };
        let (first, k) = (7, 3);
        for isa in Isa::available() {
            let partner = |at: usize| [(at * 31 % nodes.len()) as u32, GONE][usize::from(at == 4)];
            let count = k * (nodes.len() - first);
            let mut lists: Vec<Candidate> = (0..count).map(|at| (NONE.0, partner(at))).collect();
            let costs = PairCosts {
                nodes: &nodes,
                first,
                k,
                weights: WEIGHTS,
                lists: &mut lists,
            };
            dispatch(isa, costs);
            for (at, &(cost, j)) in lists.iter().enumerate() {
                if j == GONE {
                    assert_eq!(cost, f32::INFINITY);
                    continue;
                }
                let (i, j) = (first + at / k, j as usize);
                let (i, j) = (i.min(j), i.max(j));
                let color = color_distance(nodes.sh_of(i), nodes.sh_of(j));
                let alone = nodes.geometry[i].cost(&nodes.geometry[j], color, WEIGHTS);
                assert_eq!(cost.to_bits(), alone.to_bits(), "{isa:?}: {i} {j}");
            }
        }
    }

    #[test]
    fn many_nodes_at_one_place_find_different_partners() {
        let geometry: Vec<Node> = (0..40)
            .map(|i| {
                Node {
                    mean: [if i < 20 { 0.0 } else { i as f32 }, 0.0, 0.0],
                    cov: [1.0, 0.0, 0.0, 1.0, 0.0, 1.0],
                    alpha: 0.5,
                    visibility: 1.0,
                    ..Node::default()
                }
                .weighed()
            })
            .collect();
        let nodes = Nodes {
            sh: vec![0.0; 3 * geometry.len()],
            geometry,
            width: 3,
        };
        let k = 4;
        let lists = candidates(&nodes, k, WEIGHTS, &Control::default()).unwrap();
        for i in 0..20 {
            let mut own: Vec<u32> = lists[i * k..(i + 1) * k].iter().map(|c| c.1).collect();
            own.sort_unstable();
            let first = i.saturating_sub(2).min(35);
            let want: Vec<u32> = (first as u32..)
                .filter(|&j| j != i as u32)
                .take(k)
                .collect();
            assert_eq!(own, want, "{i}");
        }
        for i in 25..35 {
            let near = |c: &Candidate| c.1.abs_diff(i as u32) <= 2;
            assert!(lists[i * k..(i + 1) * k].iter().all(near), "{i}");
        }
        assert!(matched(&lists, k, 40).len() >= 18);
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
        for (cost, i, _, j) in edges {
            if !locked[i] && !locked[j as usize] {
                locked[i] = true;
                locked[j as usize] = true;
                let (a, b) = ((i as u32).min(j), (i as u32).max(j));
                want.push(Pair { a, b, cost });
            }
        }
        assert_eq!(matched(&lists, k, n), want);
        assert_eq!(matched(&lists, k, 20), want[..20]);
    }
}
