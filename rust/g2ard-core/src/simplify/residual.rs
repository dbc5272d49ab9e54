//! Protection flags: where an affine function of position cannot predict colour.

use crate::spatial::Frame;
use crate::{Backend, Control, Result, Splats};

/// Band-0 spherical harmonic: colour = 0.5 + SH_C0·sh0.
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// A cell with fewer members borrows those of its face neighbours: two for each affine coefficient.
const ENOUGH: usize = 8;

/// The base colour, not clamped.
pub fn color(splats: &Splats, i: usize) -> [f64; 3] {
    splats.sh_of(i)[0].map(|v| 0.5 + SH_C0 * f64::from(v))
}

/// p_i = 1[E_c(i) > ε_h] (eq. `frequency`), over about `cells` cells.
pub fn flags(
    splats: &Splats,
    cells: usize,
    threshold: f64,
    backend: &dyn Backend,
    control: &Control,
) -> Result<Vec<bool>> {
    let grid = backend.cells(&splats.means, &Frame::of(&splats.means), cells)?;
    let group = |cell: usize, rows: &mut Vec<u32>| {
        let own = grid.members_of(cell);
        rows.extend_from_slice(own);
        if own.len() < ENOUGH {
            rows.extend(grid.face_neighbors(cell).flat_map(|c| grid.members_of(c)));
        }
        own.len()
    };
    let energies = backend.energies(splats, grid.len(), &group, control)?;
    let mut out = vec![false; splats.len()];
    for cell in (0..grid.len()).filter(|&c| energies[c] > threshold) {
        grid.members_of(cell)
            .iter()
            .for_each(|&i| out[i as usize] = true);
    }
    Ok(out)
}
