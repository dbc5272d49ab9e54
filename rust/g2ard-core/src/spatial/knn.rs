//! Exact nearest neighbours: an eight-way box tree over blocks of eight points in Morton order.

use rayon::prelude::*;

use super::{Frame, codes, order};

const WIDTH: usize = 8;
type Lanes = [f64; WIDTH];

/// Squared distance and row.
pub type Neighbor = (f64, u32);

/// Eight boxes, side by side.
#[derive(Clone, Copy)]
struct Boxes {
    low: [Lanes; 3],
    high: [Lanes; 3],
}

const NOWHERE: Boxes = Boxes {
    low: [[f64::INFINITY; WIDTH]; 3],
    high: [[f64::NEG_INFINITY; WIDTH]; 3],
};

impl Boxes {
    /// Squared distances from `q`; infinite for an empty box.
    fn distances(&self, q: [f64; 3]) -> Lanes {
        let mut sum = [0.0; WIDTH];
        for k in 0..3 {
            for i in 0..WIDTH {
                let d = (self.low[k][i] - q[k]).max(q[k] - self.high[k][i]).max(0.0);
                sum[i] += d * d;
            }
        }
        sum
    }

    fn union(&self) -> ([f64; 3], [f64; 3]) {
        let fold = |v: &Lanes, start, f: fn(f64, f64) -> f64| v.iter().copied().fold(start, f);
        (
            [0, 1, 2].map(|k| fold(&self.low[k], f64::INFINITY, f64::min)),
            [0, 1, 2].map(|k| fold(&self.high[k], f64::NEG_INFINITY, f64::max)),
        )
    }
}

/// Finds neighbours of the points it was built from.
pub struct Tree {
    rows: Vec<u32>,
    /// Points in Morton order, eight to a block; lanes beyond the end are at infinity.
    blocks: Vec<[Lanes; 3]>,
    /// `levels[0]` bounds blocks, each next level bounds the one below; the last is one node.
    levels: Vec<Vec<Boxes>>,
}

impl Tree {
    pub fn build(points: &[[f64; 3]]) -> Self {
        let rows = order(&codes(points, &Frame::of(points)));
        Self::over(points, rows)
    }

    /// `rows`: the rows of `points` in an order that keeps near points together.
    pub fn over(points: &[[f64; 3]], rows: Vec<u32>) -> Self {
        let blocks: Vec<[Lanes; 3]> = rows
            .par_chunks(WIDTH)
            .map(|chunk| {
                let mut block = [[f64::INFINITY; WIDTH]; 3];
                for (i, &row) in chunk.iter().enumerate() {
                    (0..3).for_each(|k| block[k][i] = points[row as usize][k]);
                }
                block
            })
            .collect();
        let bounds = blocks
            .par_iter()
            .map(|b| {
                let finite = |k: usize| b[k].iter().copied().filter(|v| v.is_finite());
                (
                    [0, 1, 2].map(|k| finite(k).fold(f64::INFINITY, f64::min)),
                    [0, 1, 2].map(|k| finite(k).fold(f64::NEG_INFINITY, f64::max)),
                )
            })
            .collect::<Vec<_>>();
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
    pub fn nearest(&self, at: usize, k: usize, found: &mut Vec<Neighbor>) {
        found.clear();
        if k == 0 {
            return;
        }
        let block = &self.blocks[at / WIDTH];
        let q = [0, 1, 2].map(|axis| block[axis][at % WIDTH]);
        let mut search = Search {
            q,
            itself: self.rows[at],
            k,
            found,
        };
        self.visit(self.levels.len() - 1, 0, &mut search);
    }

    fn visit(&self, level: usize, node: usize, search: &mut Search) {
        let distances = self.levels[level][node].distances(search.q);
        let limit = search.limit();
        let (mut near, mut count) = ([(0.0, 0usize); WIDTH], 0);
        for (i, &d) in distances.iter().enumerate() {
            if d <= limit && d < f64::INFINITY {
                let mut at = count;
                while at > 0 && near[at - 1].0 > d {
                    near[at] = near[at - 1];
                    at -= 1;
                }
                near[at] = (d, i);
                count += 1;
            }
        }
        for &(d, i) in &near[..count] {
            if d > search.limit() {
                break;
            }
            let child = node * WIDTH + i;
            if level == 0 {
                self.scan(child, search);
            } else {
                self.visit(level - 1, child, search);
            }
        }
    }

    fn scan(&self, block: usize, search: &mut Search) {
        let points = &self.blocks[block];
        let mut sum = [0.0; WIDTH];
        for k in 0..3 {
            for i in 0..WIDTH {
                let d = points[k][i] - search.q[k];
                sum[i] += d * d;
            }
        }
        let limit = search.limit();
        for (i, &d) in sum.iter().enumerate() {
            if d <= limit && d < f64::INFINITY {
                search.offer((d, self.rows[block * WIDTH + i]));
            }
        }
    }
}

fn pack(bounds: &[([f64; 3], [f64; 3])]) -> Vec<Boxes> {
    let packed = bounds.chunks(WIDTH).map(|chunk| {
        let mut boxes = NOWHERE;
        for (i, (low, high)) in chunk.iter().enumerate() {
            for k in 0..3 {
                (boxes.low[k][i], boxes.high[k][i]) = (low[k], high[k]);
            }
        }
        boxes
    });
    let packed: Vec<_> = packed.collect();
    if packed.is_empty() {
        vec![NOWHERE]
    } else {
        packed
    }
}

struct Search<'a> {
    q: [f64; 3],
    itself: u32,
    k: usize,
    found: &'a mut Vec<Neighbor>,
}

impl Search<'_> {
    /// Nothing farther than this can still get in.
    fn limit(&self) -> f64 {
        if self.found.len() < self.k {
            f64::INFINITY
        } else {
            self.found[self.k - 1].0
        }
    }

    fn offer(&mut self, new: Neighbor) {
        if new.1 == self.itself {
            return;
        }
        if self.found.len() == self.k {
            if new >= self.found[self.k - 1] {
                return;
            }
            self.found.pop();
        }
        let at = self
            .found
            .iter()
            .rposition(|&old| old < new)
            .map_or(0, |i| i + 1);
        self.found.insert(at, new);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn brute(points: &[[f64; 3]], i: usize, k: usize) -> Vec<Neighbor> {
        let mut all: Vec<Neighbor> = (0..points.len())
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
        let mut state = 9u64;
        let mut next = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
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
