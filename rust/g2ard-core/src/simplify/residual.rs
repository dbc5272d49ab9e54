//! Protection flags: where an affine function of position cannot predict colour.

use rayon::prelude::*;

use crate::linalg::affine_energy;
use crate::spatial::{Cells, Frame};
use crate::{Control, Result, Splats};

/// Band-0 spherical harmonic: colour = 0.5 + SH_C0·sh0.
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// A cell with fewer members borrows those of its face neighbours: two for each affine coefficient.
const ENOUGH: usize = 8;

const CHUNK: usize = 256;

/// The base colour, not clamped.
pub fn color(splats: &Splats, i: usize) -> [f64; 3] {
    splats.sh_of(i)[0].map(|v| 0.5 + SH_C0 * f64::from(v))
}

/// p_i = 1[E_c(i) > ε_h] (eq. `frequency`), over about `cells` cells.
pub fn flags(
    splats: &Splats,
    cells: usize,
    threshold: f64,
    control: &Control,
) -> Result<Vec<bool>> {
    let grid = Cells::adaptive(&splats.means, &Frame::of(&splats.means), cells);
    let ids: Vec<usize> = (0..grid.len()).collect();
    let textured: Vec<Vec<bool>> = ids
        .par_chunks(CHUNK)
        .map(|chunk| {
            control.check()?;
            Ok(chunk
                .iter()
                .map(|&c| energy(splats, &grid, c) > threshold)
                .collect())
        })
        .collect::<Result<_>>()?;
    let mut out = vec![false; splats.len()];
    for (cell, _) in textured.concat().into_iter().enumerate().filter(|t| t.1) {
        grid.members_of(cell)
            .iter()
            .for_each(|&i| out[i as usize] = true);
    }
    Ok(out)
}

/// E_j of a cell.
fn energy(splats: &Splats, grid: &Cells, cell: usize) -> f64 {
    let own = grid.members_of(cell);
    let mut rows = own.to_vec();
    if own.len() < ENOUGH {
        rows.extend(grid.face_neighbors(cell).flat_map(|c| grid.members_of(c)));
    }
    let points: Vec<_> = rows.iter().map(|&i| splats.means[i as usize]).collect();
    let colors: Vec<_> = rows.iter().map(|&i| color(splats, i as usize)).collect();
    affine_energy(&points, &colors, own.len())
}
