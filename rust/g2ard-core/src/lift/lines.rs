//! Points in lines, such as a scanner's rings: neighbourhoods grow by thinning the lines until they span the surface.

use rayon::prelude::*;

use super::{Patch, extent};
use crate::linalg::{Eigen, cross, dot, quat_from_rotation, rotation_from_quat};
use crate::spatial::Tree;
use crate::{Control, Result};

/// A neighbourhood whose second standard deviation is at least this share of the first spans a surface, if the third
/// is at most this share of the second.
const LINE: f64 = 0.5;
/// Above this share, a neighbourhood keeps its extent, and its normal if the wider one is within 30°.
const FLAT: f64 = 0.25;
const TURNED: f64 = 0.866_025_403_784_438_6;
/// Cells of thinned lines, from the smallest to the largest, over a point's extent along its line.
const CELLS: [f64; 2] = [0.5, 8.0];
/// Distance of the farthest neighbour of a thinned line, in cells.
const REACH: f64 = 5.0;

/// Extent of a disc across its line over the standard deviation of the wider neighbourhood: along a line many discs
/// overlap, so that narrower ones cover the surface and blur less.
const ACROSS: f64 = 0.8;

/// A point whose neighbours are nearly on a line.
struct Line {
    /// Its place in the order of the tree, and its row.
    at: usize,
    row: u32,
    octaves: [i32; 2],
    open: bool,
}

impl Line {
    fn active(&self, octave: i32) -> bool {
        self.open && (self.octaves[0]..=self.octaves[1]).contains(&octave)
    }
}

/// Replaces the patches (in the tree's order) of points in lines by those of the smallest neighbourhood, in octaves, that
/// spans a surface. Points without one keep theirs.
pub(super) fn widen(
    points: &[[f64; 3]],
    rows: &[u32],
    patches: &mut [Patch],
    neighbors: usize,
    control: &Control,
) -> Result<()> {
    let in_line = |p: &Patch| p.sigmas[1] < LINE * p.sigmas[0] && p.sigmas[0].is_finite();
    let found = patches.iter().enumerate().filter(|(_, p)| in_line(p));
    let mut lines: Vec<Line> = found
        .map(|(at, p)| Line {
            at,
            row: rows[at],
            octaves: CELLS.map(|c| octave(c * p.sigmas[0])),
            open: true,
        })
        .collect();
    let first = lines.iter().map(|l| l.octaves[0]).min().unwrap_or(0);
    let last = lines.iter().map(|l| l.octaves[1]).max().unwrap_or(-1);
    for octave in first..=last {
        control.check()?;
        if !lines.iter().any(|l| l.active(octave)) {
            continue;
        }
        let spans = spans(points, &lines, octave, neighbors);
        for (line, span) in lines.iter_mut().zip(spans) {
            if let Some(e) = span {
                line.open = false;
                turn(&mut patches[line.at], &e);
            }
        }
    }
    Ok(())
}

/// ⌊log₂⌋ of a normal number.
fn octave(value: f64) -> i32 {
    (value.to_bits() >> 52 & 0x7ff) as i32 - 1023
}

/// The neighbourhood of each active line's cell, if it spans a surface. A cell stands for the mean of its points.
fn spans(points: &[[f64; 3]], lines: &[Line], octave: i32, neighbors: usize) -> Vec<Option<Eigen>> {
    let size = 2f64.powi(octave);
    let mut keyed: Vec<([i64; 3], u32)> = lines
        .par_iter()
        .enumerate()
        .map(|(i, l)| {
            (
                points[l.row as usize].map(|v| (v / size).floor() as i64),
                i as u32,
            )
        })
        .collect();
    keyed.par_sort_unstable();
    let cells: Vec<&[([i64; 3], u32)]> = keyed.chunk_by(|a, b| a.0 == b.0).collect();
    let means: Vec<[f64; 3]> = cells
        .par_iter()
        .map(|cell| {
            let of = |k: usize| {
                cell.iter()
                    .map(move |&(_, i)| points[lines[i as usize].row as usize][k])
            };
            [0, 1, 2].map(|k| of(k).sum::<f64>() / cell.len() as f64)
        })
        .collect();
    let active: Vec<bool> = cells
        .par_iter()
        .map(|cell| cell.iter().any(|&(_, i)| lines[i as usize].active(octave)))
        .collect();
    let tree = Tree::build(&means);
    let found: Vec<(usize, Eigen)> = tree
        .rows()
        .par_chunks(64)
        .enumerate()
        .flat_map_iter(|(chunk, here)| {
            let mut found = Vec::new();
            if here.iter().any(|&cell| active[cell as usize]) {
                let range = chunk * 64..chunk * 64 + here.len();
                tree.nearest(range, 2 * neighbors, |at, near| {
                    let cell = tree.rows()[at];
                    near.retain(|n| n.0 <= (REACH * size).powi(2));
                    if active[cell as usize] && near.len() >= neighbors / 2 {
                        let e = extent(&means, cell, near);
                        if e.values[1] >= LINE * LINE * e.values[0]
                            && e.values[2] <= LINE * LINE * e.values[1]
                            && e.values[0] > 0.0
                        {
                            found.push((cell as usize, e));
                        }
                    }
                });
            }
            found
        })
        .collect();
    let mut spans = vec![None; lines.len()];
    for (cell, e) in found {
        for &(_, i) in cells[cell] {
            spans[i as usize] = lines[i as usize].active(octave).then_some(e);
        }
    }
    spans
}

/// Gives a patch the plane of a wider neighbourhood: its own extent along its line, the wider one's across.
fn turn(patch: &mut Patch, e: &Eigen) {
    let own = rotation_from_quat(patch.quat);
    let [line, normal] = [0, 2].map(|c| [0, 1, 2].map(|r| own[r][c]));
    let n = e.vectors[2];
    if patch.sigmas[1] >= FLAT * patch.sigmas[0] && dot(n, normal).abs() > TURNED {
        return;
    }
    let lift = dot(line, n);
    let flat = [0, 1, 2].map(|k| line[k] - lift * n[k]);
    let length = dot(flat, flat).sqrt();
    let across = if length > 1e-6 {
        cross(n, flat.map(|v| v / length))
    } else {
        e.vectors[0]
    };
    let along = cross(across, n);
    let share = [0, 1].map(|k| e.values[k].max(0.0) * dot(across, e.vectors[k]).powi(2));
    let (wide, narrow) = (ACROSS * (share[0] + share[1]).sqrt(), patch.sigmas[0]);
    let [t1, t2] = if wide >= narrow {
        [across, along]
    } else {
        [along, across]
    };
    patch.sigmas = [wide.max(narrow), wide.min(narrow)];
    patch.quat = quat_from_rotation(&[0, 1, 2].map(|r| [t1[r], t2[r], n[r]]));
}
