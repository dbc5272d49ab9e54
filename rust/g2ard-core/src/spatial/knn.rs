//! Exact nearest neighbours: an eight-way box tree over blocks of eight points in Morton order.
//!
//! Exact in the arithmetic of the coordinates: f64 where cancellation matters, f32 where speed does.

use std::ops::{AddAssign, Mul, Sub};

use rayon::prelude::*;

use super::{RobustBounds, codes, order};

const WIDTH: usize = 8;
type Lanes<T> = [T; WIDTH];

/// f32 or f64.
pub trait Real:
    Copy + PartialOrd + Send + Sync + Default + Sub<Output = Self> + Mul<Output = Self> + AddAssign
{
    const INFINITY: Self;
    const NEG_INFINITY: Self;
    fn least(self, other: Self) -> Self;
    fn most(self, other: Self) -> Self;
}

macro_rules! real {
    ($t:ident) => {
        impl Real for $t {
            const INFINITY: Self = $t::INFINITY;
            const NEG_INFINITY: Self = $t::NEG_INFINITY;

            #[inline(always)]
            fn least(self, other: Self) -> Self {
                if self < other { self } else { other }
            }

            #[inline(always)]
            fn most(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
        }
    };
}

real!(f32);
real!(f64);

/// Squared distance and row.
pub type Neighbor<T> = (T, u32);

/// Eight boxes, side by side.
#[derive(Clone, Copy)]
struct Boxes<T> {
    low: [Lanes<T>; 3],
    high: [Lanes<T>; 3],
}

impl<T: Real> Boxes<T> {
    const NOWHERE: Self = Self {
        low: [[T::INFINITY; WIDTH]; 3],
        high: [[T::NEG_INFINITY; WIDTH]; 3],
    };

    /// Squared distances from `q`; infinite for an empty box.
    #[inline(always)]
    fn distances(&self, q: [T; 3]) -> Lanes<T> {
        let mut sum = [T::default(); WIDTH];
        for k in 0..3 {
            for i in 0..WIDTH {
                let d = (self.low[k][i] - q[k])
                    .most(q[k] - self.high[k][i])
                    .most(T::default());
                sum[i] += d * d;
            }
        }
        sum
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

impl<T: Real> Tree<T> {
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

    /// The `k` points nearest to the `at`-th of [`Tree::rows`], itself excepted, by (distance, row), into `found`.
    #[inline]
    pub fn nearest(&self, at: usize, k: usize, found: &mut Vec<Neighbor<T>>) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.nearest_avx2(at, k, found) };
        }
        self.search(at, k, found);
    }

    /// The same code with wider registers; no fused operations, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn nearest_avx2(&self, at: usize, k: usize, found: &mut Vec<Neighbor<T>>) {
        self.search(at, k, found);
    }

    #[inline(always)]
    fn search(&self, at: usize, k: usize, found: &mut Vec<Neighbor<T>>) {
        found.clear();
        if k == 0 {
            return;
        }
        let own = at / WIDTH;
        let block = &self.blocks[own];
        let mut search = Search {
            q: [0, 1, 2].map(|axis| block[axis][at % WIDTH]),
            itself: self.rows[at],
            k,
            found,
        };
        // Its own block first: near enough to rule most others out.
        self.scan(own, &mut search);
        let mut stack = [(T::default(), 0u32, 0u32); STACK];
        stack[0] = (T::default(), self.levels.len() as u32 - 1, 0);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (distance, level, node) = stack[depth];
            if distance > search.limit() {
                continue;
            }
            let distances = self.levels[level as usize][node as usize].distances(search.q);
            let limit = search.limit();
            if level == 0 {
                for (i, &d) in distances.iter().enumerate() {
                    let block = node as usize * WIDTH + i;
                    if d <= limit && d < T::INFINITY && block != own && d <= search.limit() {
                        self.scan(block, &mut search);
                    }
                }
                continue;
            }
            // Nearest on top: insertion from the bottom of this node's share of the stack.
            let base = depth;
            for (i, &d) in distances.iter().enumerate() {
                if d <= limit && d < T::INFINITY {
                    let mut at = depth;
                    while at > base && stack[at - 1].0 < d {
                        stack[at] = stack[at - 1];
                        at -= 1;
                    }
                    stack[at] = (d, level - 1, node * WIDTH as u32 + i as u32);
                    depth += 1;
                }
            }
        }
    }

    #[inline(always)]
    fn scan(&self, block: usize, search: &mut Search<T>) {
        let points = &self.blocks[block];
        let mut sum = [T::default(); WIDTH];
        for k in 0..3 {
            for i in 0..WIDTH {
                let d = points[k][i] - search.q[k];
                sum[i] += d * d;
            }
        }
        let limit = search.limit();
        for (i, &d) in sum.iter().enumerate() {
            if d <= limit && d < T::INFINITY {
                search.offer((d, self.rows[block * WIDTH + i]));
            }
        }
    }
}

/// Eleven levels hold 2³² points; each leaves at most eight nodes on the stack.
const STACK: usize = 11 * WIDTH;

fn pack<T: Real>(bounds: &[([T; 3], [T; 3])]) -> Vec<Boxes<T>> {
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

struct Search<'a, T> {
    q: [T; 3],
    itself: u32,
    k: usize,
    found: &'a mut Vec<Neighbor<T>>,
}

impl<T: Real> Search<'_, T> {
    /// Nothing farther than this can still get in.
    #[inline(always)]
    fn limit(&self) -> T {
        if self.found.len() < self.k {
            T::INFINITY
        } else {
            self.found[self.k - 1].0
        }
    }

    #[inline(always)]
    fn offer(&mut self, new: Neighbor<T>) {
        if new.1 == self.itself {
            return;
        }
        if self.found.len() < self.k {
            self.found.push(new);
        } else if new < self.found[self.k - 1] {
            self.found[self.k - 1] = new;
        } else {
            return;
        }
        let mut at = self.found.len() - 1;
        while at > 0 && new < self.found[at - 1] {
            self.found[at] = self.found[at - 1];
            at -= 1;
        }
        self.found[at] = new;
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
        let mut found = Vec::new();
        for (at, &row) in tree.rows().iter().enumerate() {
            tree.nearest(at, k, &mut found);
            assert_eq!(found, brute(points, row as usize, k));
        }
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
