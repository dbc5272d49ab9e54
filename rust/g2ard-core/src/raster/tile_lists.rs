//! The exact tiles that each splat meets.

use std::ops::Range;

use super::TILE;
use super::grid::TileGrid;
use super::simd::{LANES, Lanes, Lanes16};

/// Tiles a [`TileList`] holds inline: as many as fit into half a cache line.
const INLINE: usize = 12;

/// One splat's tiles, row by row, left to right.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(32))]
pub struct TileList {
    /// Its first slot, among those of its chunk.
    pub slot: u32,
    pub tiles: u32,
    /// The tiles. Of more than `INLINE`, or in an image of more tiles than a u16 counts: where they start in the
    /// chunk's overflow list, as two halves.
    inline: [u16; INLINE],
}

const _: () = assert!(size_of::<TileList>() == 32);

impl TileList {
    /// Stores the `count` tiles of `rows`, each a range of tile numbers; what does not fit goes to the overflow list.
    #[inline(always)]
    fn set(
        &mut self,
        slot: u32,
        count: u32,
        narrow: bool,
        rows: impl Iterator<Item = Range<u32>>,
        list: &mut Vec<u32>,
    ) {
        (self.slot, self.tiles) = (slot, count);
        if narrow && count as usize <= INLINE {
            let mut at = 0;
            for row in rows {
                for tile in row {
                    self.inline[at % INLINE] = tile as u16;
                    at += 1;
                }
            }
        } else {
            (self.inline[0], self.inline[1]) = (list.len() as u16, (list.len() >> 16) as u16);
            list.extend(rows.flatten());
        }
    }

    /// Calls `visit(tile, slot)`; `first` is the chunk's first slot.
    #[inline(always)]
    pub fn for_each(
        &self,
        list: &[u32],
        first: u32,
        narrow: bool,
        mut visit: impl FnMut(usize, u32),
    ) {
        let (count, slots) = (self.tiles as usize, first + self.slot..);
        if narrow && count <= INLINE {
            for (tile, slot) in self.inline[..count].iter().zip(slots) {
                visit(*tile as usize, slot);
            }
        } else {
            let start = self.inline[0] as usize | (self.inline[1] as usize) << 16;
            for (tile, slot) in list[start..start + count].iter().zip(slots) {
                visit(*tile as usize, slot);
            }
        }
    }
}

/// Sixteen splats' ellipses at α = 1/255: |U·d|² ≤ level, U = (a b; 0 c).
pub struct Ellipses<F: Lanes> {
    pub x: F,
    pub y: F,
    pub a: F,
    pub b: F,
    pub c: F,
    /// u² + v² there, with slack: kernels test every pixel, so too much costs time, never correctness.
    pub level: F,
    /// Half its width and height.
    pub half: [F; 2],
    /// INRIA's kernel cuts it to the square [centre ± radius].
    pub radius: Option<F>,
}

/// Tiles whose pixel centres' interval [16t + 0.5, 16t + 15.5] meets [low, high], within `bounds`.
#[inline(always)]
fn span<F: Lanes>(low: F, high: F, bounds: [F; 2]) -> [F; 2] {
    let (per_pixel, half, one) = (F::splat(1.0 / TILE as f32), F::splat(0.5), F::splat(1.0));
    let from = -((one - (low + half) * per_pixel).floor());
    let to = ((high - half) * per_pixel + one).floor();
    [
        from.max(bounds[0]).min(bounds[1]),
        to.max(bounds[0]).min(bounds[1]),
    ]
}

/// The tiles that INRIA's kernel assigns to a splat of this radius: those that its square touches.
#[inline(always)]
fn square_span<F: Lanes>(centre: F, radius: Option<F>, tiles: Range<usize>) -> [F; 2] {
    let (first, last) = (F::splat(tiles.start as f32), F::splat(tiles.end as f32));
    let Some(radius) = radius else {
        return [first, last];
    };
    // Its pixel coordinates have centres at whole numbers.
    let (per_pixel, centre) = (F::splat(1.0 / TILE as f32), centre - F::splat(0.5));
    let from = (centre - radius) * per_pixel;
    let to = (centre + radius + F::splat(TILE as f32 - 1.0)) * per_pixel;
    [
        from.max(first).floor().min(last),
        to.max(first).floor().min(last),
    ]
}

/// A whole number as an integer, without the several instructions of a checked cast.
///
/// # Safety
/// `value` is at least 0 and fits an i32, as what [`span`] makes: it lies between bounds (a NaN became one of them).
#[inline(always)]
unsafe fn whole(value: f32) -> usize {
    // SAFETY: the caller's promise.
    unsafe { value.to_int_unchecked::<i32>() as usize }
}

/// Intersects a chunk's ellipses with tiles; holds the overflow of its lists, and scratch memory.
#[derive(Debug, Default)]
pub struct TileIntersector {
    /// Tiles that do not fit into their lists.
    pub list: Vec<u32>,
    /// The ends of sixteen ellipses in one row of tiles after another.
    ends: Vec<[Lanes16; 2]>,
    /// Slots numbered so far; [`super::bins::Bins::fill`] refuses more than a u32 counts.
    pub slots: u64,
}

impl TileIntersector {
    pub fn clear(&mut self) {
        self.list.clear();
        self.slots = 0;
    }
}

impl<F: Lanes> Ellipses<F> {
    /// Lists the tiles whose pixel centres' rectangle meets the ellipse of each lane in `bits`, lane after lane into
    /// `out`, the slots numbered on from the chunk's last.
    #[inline(always)]
    pub fn tile_lists(
        &self,
        bits: u32,
        grid: TileGrid,
        intersector: &mut TileIntersector,
        out: &mut [TileList],
    ) {
        let (thousandth, hundredth, most) = (F::splat(1e-4), F::splat(0.01), F::splat(1e6));
        let slack_x = self.half[0].min(most).fma(thousandth, hundredth);
        let slack_y = self.half[1].min(most).fma(thousandth, hundredth);
        let (half_x, half_y) = (self.half[0] + slack_x, self.half[1] + slack_y);
        let columns = square_span(self.x, self.radius, 0..grid.columns);
        let rows = grid.first_row..grid.first_row + grid.rows;
        let rows = square_span(self.y, self.radius, rows);
        let columns = span(self.x - half_x, self.x + half_x, columns);
        let [first, last] = span(self.y - half_y, self.y + half_y, rows);
        let (mut from, mut to) = (Lanes16::default(), Lanes16::default());
        first.store(&mut from);
        last.store(&mut to);
        let r_a = F::splat(1.0) / self.a;
        let slope = -(self.b * r_a);
        // dy at the rightmost point: Σ_xy / Σ_xx = −a·b/(b² + c²) times half the width.
        let dy_right = -(self.half[0] * self.a * self.b) / self.b.fma(self.b, self.c * self.c);
        let mut tallest = 0;
        for l in 0..LANES {
            if bits >> l & 1 == 1 {
                // SAFETY: `span` made both.
                let (from, to) = unsafe { (whole(from.0[l]), whole(to.0[l])) };
                tallest = tallest.max(to.saturating_sub(from));
            }
        }
        let TileIntersector { list, ends, slots } = intersector;
        ends.resize(tallest, [Lanes16::default(); 2]);
        let mut count = F::zero();
        for (strip, ends) in ends.iter_mut().enumerate() {
            let row = first + F::splat(strip as f32);
            let [low, high] = self.chords(row, half_y, dy_right, slope, r_a, slack_x);
            let [low, high] = span(low, high, columns);
            low.store(&mut ends[0]);
            high.store(&mut ends[1]);
            let tiles = (high - low).max(F::zero());
            count = count + tiles.only(last.gt(row));
        }
        let mut counts = Lanes16::default();
        count.store(&mut counts);
        let narrow = grid.narrow();
        let mut todo = bits;
        for tile_list in out {
            let l = todo.trailing_zeros() as usize;
            todo &= todo - 1;
            // SAFETY: `span` made all ends, and a count is a sum of their differences, at most the tiles of the grid.
            let whole = |value| unsafe { whole(value) };
            let rows = (whole(from.0[l])..whole(to.0[l]))
                .zip(&*ends)
                .map(|(row, e)| {
                    let first = ((row - grid.first_row) * grid.columns) as u32;
                    first + whole(e[0].0[l]) as u32..first + whole(e[1].0[l]) as u32
                });
            tile_list.set(*slots as u32, whole(counts.0[l]) as u32, narrow, rows, list);
            *slots += u64::from(tile_list.tiles);
        }
    }

    /// The leftmost and rightmost x of the ellipses within rows of tiles. A chord's end is a concave function of dy:
    /// its extreme over the strip is at the ellipse's own, or nearest to it.
    #[inline(always)]
    fn chords(&self, row: F, half_y: F, dy_right: F, slope: F, r_a: F, slack: F) -> [F; 2] {
        let top = row.fma(F::splat(TILE as f32), F::splat(0.5) - self.y);
        let bottom = (top + F::splat(TILE as f32 - 1.0)).min(half_y);
        let top = top.max(-half_y);
        let (top, bottom) = (top.min(bottom), top.max(bottom));
        let mut ends = [F::zero(); 2];
        for side in 0..2 {
            let dy = if side == 0 { -dy_right } else { dy_right };
            let dy = dy.max(top).min(bottom);
            let v = self.c * dy;
            let reach = v.fnma(v, self.level).max(F::zero()).sqrt().fma(r_a, slack);
            let middle = slope.fma(dy, self.x);
            ends[side] = if side == 0 {
                middle - reach
            } else {
                middle + reach
            };
        }
        ends
    }
}

#[cfg(test)]
mod tests {
    use super::super::project::Splat;
    use super::super::simd::{Isa, Kernel, dispatch};
    use super::*;
    use crate::random::Lcg;

    /// One splat's tile_list, in lane 0.
    struct Covers<'a> {
        splat: &'a Splat,
        grid: TileGrid,
        intersector: &'a mut TileIntersector,
        out: &'a mut [TileList],
    }

    impl Kernel for Covers<'_> {
        type Output = ();
        #[inline(always)]
        fn run<F: Lanes>(self) {
            let s = self.splat;
            let half = s.half_extents();
            let ellipses = Ellipses {
                x: F::splat(s.x as f32),
                y: F::splat(s.y as f32),
                a: F::splat(s.a),
                b: F::splat(s.b),
                c: F::splat(s.c),
                level: F::splat(s.level()),
                half: [F::splat(half[0]), F::splat(half[1])],
                radius: None,
            };
            ellipses.tile_lists(1, self.grid, self.intersector, self.out);
        }
    }

    /// The exact tiles, by testing a fine grid of points between the first and last pixel centres of each tile.
    fn brute(splat: &Splat, tiles: (usize, usize)) -> Vec<usize> {
        let level = f64::from(splat.level());
        let (a, b, c) = (f64::from(splat.a), f64::from(splat.b), f64::from(splat.c));
        let hit = |tile: usize| {
            let (left, top) = (
                (tile % tiles.0 * TILE) as f64 + 0.5,
                (tile / tiles.0 * TILE) as f64 + 0.5,
            );
            (0..=150).any(|i| {
                (0..=150).any(|j| {
                    let (dx, dy) = (
                        left + 0.1 * f64::from(i) - splat.x,
                        top + 0.1 * f64::from(j) - splat.y,
                    );
                    (a * dx + b * dy).powi(2) + (c * dy).powi(2) <= level
                })
            })
        };
        (0..tiles.0 * tiles.1).filter(|&t| hit(t)).collect()
    }

    #[test]
    fn tiles_are_exact() {
        let mut source = Lcg(7);
        let mut random = || source.uniform_f32();
        let tiles = (6, 5);
        let grid = TileGrid {
            columns: 6,
            first_row: 0,
            rows: 5,
        };
        let (mut met, mut extra) = (0, 0);
        let draws = if cfg!(miri) { 4 } else { 200 };
        for _ in 0..draws {
            let a = 0.02 * 60f32.powf(random());
            let splat = Splat {
                x: f64::from(random() * 140.0 - 20.0),
                y: f64::from(random() * 120.0 - 20.0),
                a,
                b: a * (random() - 0.5) * 6.0,
                c: 0.02 * 60f32.powf(random()),
                log2_opacity: -random() * 6.0,
                ..Splat::default()
            };
            let mut out = [TileList::default()];
            let mut intersector = TileIntersector::default();
            let tile_list = Covers {
                splat: &splat,
                grid,
                intersector: &mut intersector,
                out: &mut out,
            };
            dispatch(Isa::detect(), tile_list);
            let mut got = Vec::new();
            out[0].for_each(&intersector.list, 0, grid.narrow(), |t, _| got.push(t));
            let expected = brute(&splat, tiles);
            assert!(
                expected.iter().all(|t| got.contains(t)),
                "{splat:?}: {got:?} misses some of {expected:?}"
            );
            met += expected.len();
            extra += got.len() - expected.len();
        }
        assert!(
            met > draws * 5 / 2,
            "only {met} tiles: the test draws too little"
        );
        assert!(
            extra * 50 < met || cfg!(miri),
            "{extra} tiles too many of {met}"
        );
    }
}
