//! Exact nearest neighbours: an eight-way box tree over blocks of eight points in Morton order.
//!
//! Exact in the arithmetic of the coordinates: f64 where cancellation matters, f32 where speed does. The eight points
//! of a block are near each other and walk the tree together.

mod coordinate;
mod search;

use std::ops::Range;

use rayon::prelude::*;

pub use coordinate::{Coordinate, Neighbor};
use search::Search;

use super::{RobustBounds, codes, order};

const WIDTH: usize = 8;
type Lanes<T> = [T; WIDTH];

/// Eight boxes, side by side.
#[derive(Clone, Copy)]
struct Boxes<T> {
    low: [Lanes<T>; 3],
    high: [Lanes<T>; 3],
}

impl<T: Coordinate> Boxes<T> {
    const NOWHERE: Self = Self {
        low: [[T::INFINITY; WIDTH]; 3],
        high: [[T::NEG_INFINITY; WIDTH]; 3],
    };

    /// Squared distances from another box; infinite for an empty one.
    #[inline(always)]
    fn gaps(&self, low: [T; 3], high: [T; 3]) -> Lanes<T> {
        let mut sum = [T::default(); WIDTH];
        for k in 0..3 {
            for i in 0..WIDTH {
                let d = (self.low[k][i] - high[k])
                    .most(low[k] - self.high[k][i])
                    .most(T::default());
                sum[i] += d * d;
            }
        }
        sum
    }

    /// Squared distances of eight points from the `i`-th box.
    #[inline(always)]
    fn distances(&self, i: usize, points: &[Lanes<T>; 3]) -> Lanes<T> {
        let mut sum = [T::default(); WIDTH];
        for k in 0..3 {
            let (low, high) = (self.low[k][i], self.high[k][i]);
            for lane in 0..WIDTH {
                let q = points[k][lane];
                let d = (low - q).most(q - high).most(T::default());
                sum[lane] += d * d;
            }
        }
        sum
    }

    #[inline(always)]
    fn of(&self, i: usize) -> ([T; 3], [T; 3]) {
        (
            [0, 1, 2].map(|k| self.low[k][i]),
            [0, 1, 2].map(|k| self.high[k][i]),
        )
    }

    fn union(&self) -> ([T; 3], [T; 3]) {
        let fold = |v: &Lanes<T>, start, f: fn(T, T) -> T| v.iter().copied().fold(start, f);
        (
            [0, 1, 2].map(|k| fold(&self.low[k], T::INFINITY, T::least)),
            [0, 1, 2].map(|k| fold(&self.high[k], T::NEG_INFINITY, T::most)),
        )
    }
}

/// Finds neighbours of the points it was built from.
pub struct Tree<T = f64> {
    rows: Vec<u32>,
    /// Points in Morton order, eight to a block; lanes beyond the end are at infinity.
    blocks: Vec<[Lanes<T>; 3]>,
    /// `levels[0]` bounds blocks, each next level bounds the one below; the last is one node.
    levels: Vec<Vec<Boxes<T>>>,
}

impl Tree<f64> {
    pub fn build(points: &[[f64; 3]]) -> Self {
        let rows = order(&codes(points, &RobustBounds::of(points)));
        Self::over(rows, |row| points[row])
    }
}

impl<T: Coordinate> Tree<T> {
    /// `rows` in an order that keeps near points together, and where each row lies.
    pub fn over(rows: Vec<u32>, point: impl Fn(usize) -> [T; 3] + Sync) -> Self {
        let blocks: Vec<[Lanes<T>; 3]> = rows
            .par_chunks(WIDTH)
            .map(|chunk| {
                let mut block = [[T::INFINITY; WIDTH]; 3];
                for (i, &row) in chunk.iter().enumerate() {
                    let p = point(row as usize);
                    (0..3).for_each(|k| block[k][i] = p[k]);
                }
                block
            })
            .collect();
        let bounds: Vec<_> = blocks
            .par_iter()
            .map(|b| {
                let finite = |k: usize| b[k].iter().copied().filter(|v| *v < T::INFINITY);
                (
                    [0, 1, 2].map(|k| finite(k).fold(T::INFINITY, T::least)),
                    [0, 1, 2].map(|k| finite(k).fold(T::NEG_INFINITY, T::most)),
                )
            })
            .collect();
        let mut levels = vec![pack(&bounds)];
        while levels[levels.len() - 1].len() > 1 {
            let bounds: Vec<_> = levels[levels.len() - 1].iter().map(Boxes::union).collect();
            levels.push(pack(&bounds));
        }
        Self {
            rows,
            blocks,
            levels,
        }
    }

    /// The rows in the tree's own order: queries in this order find their data in cache.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// Calls `visit(at, found)` for every `at` of [`Tree::rows`] in a range: the `k` points nearest to it, itself
    /// excepted, by (distance, row).
    pub fn nearest(
        &self,
        range: Range<usize>,
        k: usize,
        visit: impl FnMut(usize, &mut Vec<Neighbor<T>>),
    ) {
        self.nearest_of(range, |_| true, k, visit);
    }

    /// The same of those `at` that are `wanted`.
    pub fn nearest_of(
        &self,
        range: Range<usize>,
        wanted: impl Fn(usize) -> bool,
        k: usize,
        mut visit: impl FnMut(usize, &mut Vec<Neighbor<T>>),
    ) {
        let mut search = Search::new(k);
        let mut found = Vec::with_capacity(k);
        for block in range.start / WIDTH..range.end.div_ceil(WIDTH) {
            let here = range.start.max(block * WIDTH)..range.end.min((block + 1) * WIDTH);
            let lanes = here
                .filter(|&at| wanted(at))
                .fold(0, |lanes, at| lanes | 1 << (at % WIDTH));
            if lanes == 0 {
                continue;
            }
            self.search(block, lanes, &mut search);
            for at in ones(lanes).map(|lane| block * WIDTH + lane) {
                found.clear();
                found.extend(search.found(at % WIDTH));
                visit(at, &mut found);
            }
        }
    }

    #[inline]
    fn search(&self, block: usize, lanes: u32, search: &mut Search<T>) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.search_avx2(block, lanes, search) };
        }
        self.search_block(block, lanes, search);
    }

    /// The same code with wider registers; no fused operations, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn search_avx2(&self, block: usize, lanes: u32, search: &mut Search<T>) {
        self.search_block(block, lanes, search);
    }

    /// Finds the nearest of the points of a block that are set in `lanes`.
    #[inline(always)]
    fn search_block(&self, own: usize, lanes: u32, search: &mut Search<T>) {
        search.begin(&self.blocks[own], lanes);
        if search.k == 0 {
            return;
        }
        // Itself and those beside it first: near enough to rule most others out.
        let beside = own.saturating_sub(1)..(own + 2).min(self.blocks.len());
        for lane in ones(lanes) {
            self.scan(own, lane, !(1 << lane), search);
            for block in beside.clone().filter(|&block| block != own) {
                self.scan(block, lane, !0, search);
            }
        }
        let (low, high) = self.levels[0][own / WIDTH].of(own % WIDTH);
        let mut stack = [(T::default(), 0u32, 0u32); STACK];
        stack[0] = (T::default(), self.levels.len() as u32 - 1, 0);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (distance, level, node) = stack[depth];
            let limit = search.limit();
            if distance > limit {
                continue;
            }
            let boxes = &self.levels[level as usize][node as usize];
            let gaps = boxes.gaps(low, high);
            let near = within(&gaps, &[limit; WIDTH]);
            if level == 0 {
                for i in ones(near) {
                    let block = node as usize * WIDTH + i;
                    if !beside.contains(&block) {
                        let distances = boxes.distances(i, &search.points);
                        for lane in ones(within(&distances, &search.limits)) {
                            self.scan(block, lane, !0, search);
                        }
                    }
                }
                continue;
            }
            // Nearest on top: insertion from the bottom of this node's share of the stack.
            let base = depth;
            for i in ones(near) {
                let mut at = depth;
                while at > base && stack[at - 1].0 < gaps[i] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (gaps[i], level - 1, node * WIDTH as u32 + i as u32);
                depth += 1;
            }
        }
    }

    /// Offer the points of a block that are set in `mask` to the search of one point.
    #[inline(always)]
    fn scan(&self, block: usize, lane: usize, mask: u32, search: &mut Search<T>) {
        let points = &self.blocks[block];
        let mut sum = [T::default(); WIDTH];
        for k in 0..3 {
            let q = search.points[k][lane];
            for i in 0..WIDTH {
                let d = points[k][i] - q;
                sum[i] += d * d;
            }
        }
        for i in ones(mask & within(&sum, &[search.limits[lane]; WIDTH])) {
            search.offer(lane, sum[i].key(self.rows[block * WIDTH + i]));
        }
    }
}

/// Bit `i` is whether the `i`-th value is at most its limit.
#[inline(always)]
fn within<T: Coordinate>(values: &Lanes<T>, limits: &Lanes<T>) -> u32 {
    let mut bits = 0;
    for i in 0..WIDTH {
        bits |= u32::from(values[i] <= limits[i]) << i;
    }
    bits
}

/// The numbers of the bits that are set, ascending.
#[inline(always)]
fn ones(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        (bits != 0).then(|| {
            let i = bits.trailing_zeros() as usize % WIDTH;
            bits &= bits - 1;
            i
        })
    })
}

/// Eleven levels hold 2³² points; each leaves at most eight nodes on the stack.
const STACK: usize = 11 * WIDTH;

fn pack<T: Coordinate>(bounds: &[([T; 3], [T; 3])]) -> Vec<Boxes<T>> {
    let packed = bounds.chunks(WIDTH).map(|chunk| {
        let mut boxes = Boxes::NOWHERE;
        for (i, (low, high)) in chunk.iter().enumerate() {
            for k in 0..3 {
                (boxes.low[k][i], boxes.high[k][i]) = (low[k], high[k]);
            }
        }
        boxes
    });
    let packed: Vec<_> = packed.collect();
    if packed.is_empty() {
        vec![Boxes::NOWHERE]
    } else {
        packed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    fn brute(points: &[[f64; 3]], i: usize, k: usize) -> Vec<Neighbor<f64>> {
        let mut all: Vec<Neighbor<f64>> = (0..points.len())
            .filter(|&j| j != i)
            .map(|j| {
                let d = crate::linalg::sub(points[j], points[i]);
                (d[0] * d[0] + d[1] * d[1] + d[2] * d[2], j as u32)
            })
            .collect();
        all.sort_by(|a, b| a.partial_cmp(b).unwrap());
        all.truncate(k);
        all
    }

    fn check(points: &[[f64; 3]], k: usize) {
        let tree = Tree::build(points);
        tree.nearest(0..points.len(), k, |at, found| {
            assert_eq!(*found, brute(points, tree.rows()[at] as usize, k));
        });
    }

    #[test]
    fn equals_brute_force_on_easy_and_hard_clouds() {
        let mut random = Lcg(9);
        let mut next = || random.centred();
        let random: Vec<[f64; 3]> = (0..700).map(|_| [next(), next(), next() * 0.01]).collect();
        check(&random, 10);
        let mut floaters = random.clone();
        floaters[3] = [2e4, 0.0, 0.0];
        floaters[9] = [-2e4, 2e4, 1.0];
        check(&floaters, 16);
        let lattice: Vec<[f64; 3]> = (0..512)
            .map(|i| [f64::from(i % 8), f64::from(i / 8 % 8), f64::from(i / 64)])
            .collect();
        check(&lattice, 10); // every distance ties
        let duplicates: Vec<[f64; 3]> = random.iter().flat_map(|&p| [p, p, p]).collect();
        check(&duplicates[..900], 7);
        check(&vec![[1.0; 3]; 100], 5);
    }

    #[test]
    fn fewer_points_than_neighbours() {
        for n in 0..12 {
            let points: Vec<_> = (0..n).map(|i| [f64::from(i), 0.0, 0.0]).collect();
            check(&points, 10);
        }
    }
}
