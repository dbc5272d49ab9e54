//! Protection flags: where an affine function of position cannot predict colour.

use super::{GroupKernels, Paper};
use crate::{Control, Result, Splats};

/// Band-0 spherical harmonic: colour = 0.5 + SH_C0·sh0.
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// The view-independent colour, clamped as renderers (at 0) and images (at 1) clamp it.
pub fn color(splats: &Splats, i: usize) -> [f64; 3] {
    splats.sh_of(i)[0].map(|v| (0.5 + SH_C0 * f64::from(v)).clamp(0.0, 1.0))
}

/// p_i = 1[E_c(i) > ε_h] (eq. `frequency`), over about `cells` cells.
pub fn protection_flags(
    splats: &Splats,
    cells: usize,
    constants: &Paper,
    kernels: &dyn GroupKernels,
    control: &Control,
) -> Result<Vec<bool>> {
    let all: Vec<u32> = (0..splats.len() as u32).collect();
    let grid = kernels.cells(splats, &all, cells)?;
    let group = |cell: usize, rows: &mut Vec<u32>| {
        let own = grid.members_of(cell);
        rows.extend_from_slice(own);
        if own.len() < constants.flag_members {
            rows.extend(grid.face_neighbors(cell).flat_map(|c| grid.members_of(c)));
        }
        own.len()
    };
    let energies = kernels.energies(splats, grid.len(), &group, control)?;
    let mut out = vec![false; all.len()];
    for cell in (0..grid.len()).filter(|&c| energies[c] > constants.flag_threshold) {
        grid.members_of(cell)
            .iter()
            .for_each(|&i| out[i as usize] = true);
    }
    Ok(out)
}
