//! Projection of a chunk of Gaussians: visible splats and the tiles that they touch.

use super::{Projected, Splat, View, colour, direction, on_image, project};
use crate::raster::bounds::GROUPS;
use crate::raster::grid::TileGrid;
use crate::raster::params::Source;
use crate::raster::simd::{Kernel, LANES, Lanes, Lanes16, Mask, Wide};
use crate::raster::tile_lists::{Ellipses, TileIntersector, TileList};
use crate::raster::{ALPHA_MIN, Convention, TILE, sh};

/// Projects the groups of sixteen rows `first..last`. Visible splats go to the front of `out` in row order, and
/// their lists of tiles to the same places of `tile_lists`. Returns their count.
pub struct Project<'a, S: Source> {
    pub view: &'a View,
    pub source: S,
    pub first: usize,
    pub last: usize,
    /// Which of the groups, [`GROUPS`] at a time, the view can see.
    pub seen: &'a [bool],
    pub grid: TileGrid,
    pub out: &'a mut [Splat],
    pub tile_lists: &'a mut [TileList],
    pub intersector: &'a mut TileIntersector,
}

impl<S: Source> Kernel for Project<'_, S> {
    type Output = usize;

    #[inline(always)]
    fn run<F: Lanes>(self) -> usize {
        let mut count = 0;
        self.intersector.clear();
        for group in self.first..self.last {
            if !self.seen[(group - self.first) / GROUPS] {
                continue;
            }
            let p = project::<F, S>(self.view, &self.source, group);
            let real_lanes = (self.source.len() - group * LANES).min(LANES);
            let visible = p.visible.and(p.on_rows(&self.grid));
            let bits = u32::from(visible.bits()) & ((1u32 << real_lanes) - 1);
            if bits == 0 {
                continue;
            }
            let end = count + bits.count_ones() as usize;
            let tile_lists = &mut self.tile_lists[count..end];
            p.ellipses(self.view)
                .tile_lists(bits, self.grid, self.intersector, tile_lists);
            let mut rgb = [F::zero(); 3];
            if S::COLOURED {
                let (dir, _) = direction::<F, S>(self.view, &self.source, group);
                let mut basis = [F::zero(); 16];
                sh::basis(self.source.sh_coeffs(), dir[0], dir[1], dir[2], &mut basis);
                rgb = colour::<F, S>(&self.source, group, &basis);
            }
            let (mut x, mut y) = ([0.0; LANES], [0.0; LANES]);
            p.x.store(&mut x);
            p.y.store(&mut y);
            let mut stored = [Lanes16::default(); 8];
            let values = [
                p.a,
                p.b,
                p.c,
                p.log2_opacity,
                rgb[0].max(F::zero()),
                rgb[1].max(F::zero()),
                rgb[2].max(F::zero()),
                p.depth,
            ];
            for k in 0..8 {
                values[k].store(&mut stored[k]);
            }
            let mut todo = bits;
            for (splat, tile_list) in self.out[count..end].iter_mut().zip(tile_lists) {
                let l = todo.trailing_zeros() as usize;
                todo &= todo - 1;
                *splat = Splat {
                    x: x[l],
                    y: y[l],
                    a: stored[0].0[l],
                    b: stored[1].0[l],
                    c: stored[2].0[l],
                    log2_opacity: stored[3].0[l],
                    rgb: [stored[4].0[l], stored[5].0[l], stored[6].0[l]],
                    depth: stored[7].0[l],
                    row: (group * LANES + l) as u32,
                    tiles: tile_list.tiles,
                    slot: tile_list.slot,
                };
            }
            count = end;
        }
        count
    }
}

impl<F: Lanes> Projected<F> {
    /// Lanes that may touch the grid's rows of tiles.
    #[inline(always)]
    fn on_rows(&self, grid: &TileGrid) -> F::Mask {
        let first = (grid.first_row * TILE) as f32;
        let y = F::narrow(self.y) - F::splat(first);
        on_image(y, self.half[1], (grid.rows * TILE) as f32)
    }

    /// The outlines at α = 1/255, slightly enlarged against rounding (see [`Ellipses::level`]).
    #[inline(always)]
    fn ellipses(&self, view: &View) -> Ellipses<F> {
        let reach = (self.log2_opacity - F::splat(ALPHA_MIN.log2())).max(F::zero());
        Ellipses {
            x: F::narrow(self.x),
            y: F::narrow(self.y),
            a: self.a,
            b: self.b,
            c: self.c,
            level: reach.fma(F::splat(1.000_1), F::splat(1e-4)),
            half: self.half,
            radius: match view.convention {
                Convention::Gsplat => None,
                Convention::Inria => Some(self.radius),
            },
        }
    }
}
