//! Cells of one size, chosen so that about a target number of them is occupied.

use std::convert::Infallible;

use rayon::prelude::*;

use super::morton::{BITS, code_inside, decode, encode, unit};
use super::{RobustBounds, codes};

/// Tolerance of the count of occupied cells, and most changes of the size to reach it.
const TOLERANCE: f64 = 0.02;
const MAX_STEPS: usize = 20;

/// A partition of rows into cubic cells, in Morton order of the cells; rows ascend within a cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Cells {
    /// Edge length.
    pub size: f64,
    /// Cell `c` holds `members[starts[c]..starts[c + 1]]`.
    pub starts: Vec<u32>,
    pub members: Vec<u32>,
    /// Morton code of each cell, ascending; None, at the end, for a point beyond the lattice, which is a cell of its own.
    pub keys: Vec<Option<u64>>,
}

impl Cells {
    /// Cells whose count is within 2 % of `target`, or the best of 20 sizes.
    ///
    /// The count at every power of two comes from one sort, by Morton prefix; what remains is a
    /// bracketed secant on log count against log size within one octave.
    pub fn adaptive(points: &[[f64; 3]], bounds: &RobustBounds, target: usize) -> Self {
        let size = match points {
            [] => bounds.radius,
            _ => {
                let octaves = counts_by_octave(points, bounds);
                let counted = |size| Ok::<_, Infallible>(count(points, bounds, size));
                let Ok(size) = search_size(bounds, &octaves, target, counted);
                size
            }
        };
        Self::with_size(points, bounds, size)
    }

    pub fn with_size(points: &[[f64; 3]], bounds: &RobustBounds, size: f64) -> Self {
        let mut keyed: Vec<(u64, u32)> = points
            .par_iter()
            .enumerate()
            .map(|(i, &p)| (code_inside(p, bounds, size).unwrap_or(u64::MAX), i as u32))
            .collect();
        keyed.par_sort_unstable();
        let (mut starts, mut keys) = (Vec::new(), Vec::new());
        for (i, &(key, _)) in keyed.iter().enumerate() {
            if i == 0 || key != keyed[i - 1].0 || key == u64::MAX {
                starts.push(i as u32);
                keys.push((key != u64::MAX).then_some(key));
            }
        }
        starts.push(points.len() as u32);
        Self {
            size,
            starts,
            members: keyed.into_par_iter().map(|(_, i)| i).collect(),
            keys,
        }
    }

    pub fn len(&self) -> usize {
        self.keys.len()
    }

    pub fn members_of(&self, cell: usize) -> &[u32] {
        &self.members[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// The cells that share a face with `cell`, lower before higher along x, y, z.
    pub fn face_neighbors(&self, cell: usize) -> impl Iterator<Item = usize> + '_ {
        let here = self.keys[cell].map(decode);
        let steps = [0, 1, 2]
            .into_iter()
            .flat_map(|axis| [(axis, -1i64), (axis, 1)]);
        steps.filter_map(move |(axis, step)| {
            let mut there = here?;
            there[axis] = there[axis].checked_add_signed(step)?;
            if there[axis] >> BITS != 0 {
                return None;
            }
            self.keys
                .binary_search_by(|k| k.unwrap_or(u64::MAX).cmp(&encode(there)))
                .ok()
        })
    }
}

/// Occupied cells at a size; points beyond the lattice count one each.
fn count(points: &[[f64; 3]], bounds: &RobustBounds, size: f64) -> usize {
    let mut keys: Vec<u64> = points
        .par_iter()
        .map(|&p| code_inside(p, bounds, size).unwrap_or(u64::MAX))
        .collect();
    keys.par_sort_unstable();
    let distinct = keys
        .windows(2)
        .filter(|w| w[0] != w[1] || w[0] == u64::MAX)
        .count();
    distinct + usize::from(!keys.is_empty())
}

/// Occupied cells of size unit·2^b for every b, from one sort.
fn counts_by_octave(points: &[[f64; 3]], bounds: &RobustBounds) -> Vec<usize> {
    let mut sorted = codes(points, bounds);
    sorted.par_sort_unstable();
    let mut apart = [0; OCTAVES];
    for w in sorted.windows(2) {
        if w[0] != w[1] {
            apart[first_apart(w[0], w[1])] += 1;
        }
    }
    octave_counts(&apart)
}

/// The octaves of a lattice, its whole cube among them.
pub const OCTAVES: usize = BITS as usize + 1;

/// The octave b at which two neighbours in Morton order separate: they first differ in bit 3b … 3b+2, and are apart at
/// every finer octave.
pub fn first_apart(a: u64, b: u64) -> usize {
    (63 - (a ^ b).leading_zeros()) as usize / 3
}

/// Occupied cells per octave, from the number of neighbours in Morton order that first separate at each.
pub fn octave_counts(apart: &[usize; OCTAVES]) -> Vec<usize> {
    let mut total = 1;
    let mut counts: Vec<usize> = (0..OCTAVES)
        .rev()
        .map(|b| {
            total += apart[b];
            total
        })
        .collect();
    counts.reverse();
    counts
}

/// The size at which about `target` cells are occupied, given how many are at each octave, and a way to
/// count them at any size.
pub fn search_size<E>(
    bounds: &RobustBounds,
    counts: &[usize],
    target: usize,
    mut count: impl FnMut(f64) -> std::result::Result<usize, E>,
) -> std::result::Result<f64, E> {
    let (unit, target) = (unit(bounds), target.max(1));
    // The finest octave whose coarse end has too few cells holds the answer.
    let octave = (0..BITS as usize)
        .find(|&b| counts[b + 1] <= target)
        .unwrap_or(BITS as usize - 1);
    let base = unit * (1u64 << octave) as f64;
    let log = |n: usize| (n as f64 / target as f64).ln();
    let (mut low, mut high) = ((0.0, log(counts[octave])), (1.0, log(counts[octave + 1])));
    let mut best = if low.1.abs() < high.1.abs() {
        low
    } else {
        high
    };
    for step in 0..MAX_STEPS {
        if best.1.abs() <= TOLERANCE.ln_1p() || low.1 <= 0.0 || high.1 >= 0.0 {
            break;
        }
        let secant = low.0 + (high.0 - low.0) * low.1 / (low.1 - high.1);
        let t = if step % 3 == 2 {
            0.5 * (low.0 + high.0)
        } else {
            secant
        };
        let here = (t, log(count(base * t.exp2())?));
        if here.1.abs() < best.1.abs() {
            best = here;
        }
        *(if here.1 > 0.0 { &mut low } else { &mut high }) = here;
    }
    Ok(base * best.0.exp2())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;
    use std::collections::HashSet;

    fn surface(n: usize) -> Vec<[f64; 3]> {
        let mut random = Lcg(5);
        let mut next = || random.centred();
        (0..n)
            .map(|_| {
                let (x, y) = (next() * 10.0, next() * 10.0);
                [x, y, (x * 0.7).sin() + 0.01 * next()]
            })
            .collect()
    }

    #[test]
    fn octave_counts_match_a_set() {
        let points = surface(3000);
        let bounds = RobustBounds::of(&points);
        let counts = counts_by_octave(&points, &bounds);
        for b in [0, 12, 15, 17, 18, 20] {
            let size = unit(&bounds) * (1u64 << b) as f64;
            let set: HashSet<_> = points
                .iter()
                .map(|p| {
                    [0, 1, 2]
                        .map(|k| ((p[k] - bounds.origin[k] + bounds.radius) / size).floor() as i64)
                })
                .collect();
            assert_eq!(counts[b], set.len(), "{b}");
            assert_eq!(count(&points, &bounds, size), set.len());
        }
    }

    #[test]
    fn finds_the_asked_count() {
        let mut points = surface(20_000);
        points.push([2e5, 2e5, -2e5]);
        let bounds = RobustBounds::of(&points);
        for target in [1, 10, 100, 1000, 5000, 15_000] {
            let cells = Cells::adaptive(&points, &bounds, target);
            let off = (cells.len() as f64 / target as f64).ln().abs();
            assert!(off <= 0.0199 || target < 100, "{target}: {}", cells.len());
            assert!(
                target > 1 || cells.len() == 2,
                "one cell, and the floater's own"
            );
        }
    }

    #[test]
    fn partitions_the_rows_and_knows_its_neighbours() {
        let points = surface(2000);
        let bounds = RobustBounds::of(&points);
        let cells = Cells::adaptive(&points, &bounds, 300);
        let mut seen = cells.members.clone();
        seen.sort_unstable();
        assert_eq!(seen, (0..2000).collect::<Vec<u32>>());
        let at = |c: usize| {
            let p = points[cells.members_of(c)[0] as usize];
            [0, 1, 2]
                .map(|k| ((p[k] - bounds.origin[k] + bounds.radius) / cells.size).floor() as i64)
        };
        for c in 0..cells.len() {
            let got: HashSet<_> = cells.face_neighbors(c).collect();
            let want: HashSet<_> = (0..cells.len())
                .filter(|&d| (0..3).map(|k| (at(c)[k] - at(d)[k]).abs()).sum::<i64>() == 1)
                .collect();
            assert_eq!(got, want);
        }
    }

    #[test]
    fn degenerate_scenes_end() {
        for points in [vec![], vec![[1.0; 3]], vec![[1.0; 3]; 1000]] {
            let cells = Cells::adaptive(&points, &RobustBounds::of(&points), 10);
            assert_eq!(cells.len(), usize::from(!points.is_empty()));
        }
    }
}
