//! Points in lines, such as a scanner's rings: neighbourhoods grow by thinning the lines until they span the surface.

use rayon::prelude::*;

use super::{LiftConfig, Patch, extent};
use crate::linalg::{Eigen, cross, dot, quat_from_rotation, rotation_from_quat, sub};
use crate::spatial::Tree;
use crate::{Control, Result};

/// A neighbourhood whose second standard deviation is at least this share of the first spans a surface, if the third
/// is at most this share of the second.
pub(super) const LINE: f64 = 0.5;
/// Above this share, a neighbourhood keeps its extent, and its normal if the wider one is within 30°.
const FLAT: f64 = 0.25;
const TURNED: f64 = 0.866_025_403_784_438_6;
/// Largest height of the next line over the plane, over its distance.
const SLOPE: f64 = 0.25;
/// Cells of thinned lines, from the smallest to the largest, over a point's extent along its line.
const CELLS: [f64; 2] = [0.5, 16.0];
/// Distance of the farthest neighbour of a thinned line, in cells.
const REACH: f64 = 5.0;

/// Extent of a disc across its line over the distance of the next lines. It leaves no gaps between lines.
const ACROSS: f64 = 0.4;
/// Extent along the line over the standard deviation of the points on it: √12 / 4π / ACROSS, so that discs have the area of
/// those of even points as dense.
const ALONG: f64 = 0.689_161;

/// A point whose neighbours are nearly on a line.
pub(super) struct Line {
    /// Its place in the order of the tree, and its row.
    at: usize,
    row: u32,
    octaves: [i32; 2],
    found: Found,
}

/// Next lines found: none, one on one side, or one on each side.
#[derive(Clone, Copy, PartialEq)]
enum Found {
    None,
    Edge,
    Inner,
}

impl Line {
    fn active(&self, octave: i32) -> bool {
        self.found != Found::Inner && (self.octaves[0]..=self.octaves[1]).contains(&octave)
    }
}

/// The surface around a point in a line: its normal, the direction across the line in it, and the distance of the next
/// lines.
#[derive(Clone, Copy)]
struct Plane {
    normal: [f64; 3],
    across: [f64; 3],
    gap: f64,
    /// At the edge of the surface, the cell of the only next line, relative to the point, and a line in it.
    edge: Option<([f64; 3], u32)>,
}

impl Plane {
    /// The surface around a point with a patch, in a neighbourhood with the axes `e`. `near`: means of its other cells,
    /// nearest first, with the patch of a line in each and its index. On each side, the first cell away from the point's
    /// line is the next line; it must lie in the plane and be as good as parallel.
    fn of(
        here: [f64; 3],
        patch: &Patch,
        e: &Eigen,
        near: &[([f64; 3], &Patch, u32)],
        size: f64,
    ) -> Option<Self> {
        let line = axis(patch, 0);
        let normal = e.vectors[2];
        let lift = dot(line, normal);
        let flat = [0, 1, 2].map(|k| line[k] - lift * normal[k]);
        let length = dot(flat, flat).sqrt();
        if length <= FLAT {
            return None;
        }
        let across = cross(normal, flat.map(|v| v / length));
        let next = [-1.0, 1.0].map(|side| {
            let mut others = near.iter().map(|n| (sub(n.0, here), n.1, n.2));
            let away = |d: [f64; 3]| side * dot(d, across);
            let (d, patch, first) = others.find(|n| away(n.0) > 0.5 * size)?;
            let level = dot(d, normal).abs() <= SLOPE * away(d);
            (level && dot(axis(patch, 0), line).abs() > TURNED).then_some((d, first))
        });
        let gap = |d: [f64; 3]| dot(d, across).abs();
        let (gap, edge) = match next {
            [Some(a), Some(b)] => (0.5 * (gap(a.0) + gap(b.0)), None),
            [Some(only), None] | [None, Some(only)] => (gap(only.0), Some(only)),
            [None, None] => return None,
        };
        Some(Self {
            normal,
            across,
            gap,
            edge,
        })
    }

    /// Returns whether the surface of the only next line, found on both of its sides, is this one.
    fn continues(&self, lines: &[Line], patches: &[Patch]) -> bool {
        self.edge.is_some_and(|(d, next)| {
            let next = &lines[next as usize];
            let n = axis(&patches[next.at], 2);
            next.found == Found::Inner
                && dot(n, self.normal).abs() > TURNED
                && dot(d, n).abs() <= SLOPE * self.gap
        })
    }
}

/// Returns the narrow patches with parallel ones at most of their neighbours, unlike those of points in a line by chance; by
/// row. `rows` is the order of the patches, `beside` has the rows of each narrow patch's neighbours in turn.
pub(super) fn find(rows: &[u32], patches: &[Patch], beside: &[Vec<u32>]) -> Vec<Line> {
    let narrow = (0..patches.len()).filter(|&at| patches[at].narrow());
    let mut at_row = vec![u32::MAX; rows.len()];
    for at in narrow.clone() {
        at_row[rows[at] as usize] = at as u32;
    }
    let count = beside.iter().map(Vec::len).sum::<usize>();
    let each = count / narrow.clone().count().max(1);
    let near = beside.iter().flat_map(|b| b.chunks(each.max(1)));
    let in_line = |at: usize, near: &[u32]| {
        let line = axis(&patches[at], 0);
        let others = near.iter().map(|&n| at_row[n as usize]);
        let others = others
            .filter(|&o| o != u32::MAX)
            .map(|o| axis(&patches[o as usize], 0));
        2 * others.filter(|&o| dot(o, line).abs() > TURNED).count() > near.len()
    };
    let mut lines: Vec<Line> = narrow
        .zip(near)
        .filter(|&(at, near)| in_line(at, near))
        .map(|(at, _)| Line {
            at,
            row: rows[at],
            octaves: CELLS.map(|c| octave(c * patches[at].sigmas[0])),
            found: Found::None,
        })
        .collect();
    lines.sort_unstable_by_key(|l| l.row);
    lines
}

/// Replaces the patches (in the tree's order) of points in lines by those of the smallest neighbourhood, in octaves, that
/// spans a surface with a next line on each side. A line with a next one on one side, also an octave later, is at the edge
/// of that one's surface, or of none. Other points keep their patches.
pub(super) fn widen(
    points: &[[f64; 3]],
    mut lines: Vec<Line>,
    patches: &mut [Patch],
    config: &LiftConfig,
    control: &Control,
) -> Result<()> {
    let first = lines.iter().map(|l| l.octaves[0]).min().unwrap_or(0);
    let last = lines.iter().map(|l| l.octaves[1]).max().unwrap_or(-1);
    let mut edges = Vec::new();
    for octave in first..=last {
        control.check()?;
        if !lines.iter().any(|l| l.active(octave)) {
            continue;
        }
        for (i, plane) in spans(points, &lines, patches, octave, config.neighbors) {
            let line = &mut lines[i as usize];
            match plane.edge {
                None => {
                    line.found = Found::Inner;
                    turn(&mut patches[line.at], &plane, config.max_anisotropy);
                }
                Some(_) if line.found == Found::Edge => {}
                Some(_) => {
                    line.found = Found::Edge;
                    line.octaves[1] = line.octaves[1].min(octave + 1);
                    edges.push((i, plane));
                }
            }
        }
    }
    for (i, plane) in edges {
        let Line { at, found, .. } = lines[i as usize];
        if found == Found::Edge && plane.continues(&lines, patches) {
            turn(&mut patches[at], &plane, config.max_anisotropy);
        }
    }
    for line in &lines {
        let patch = &mut patches[line.at];
        if patch.sigmas[0] < patch.sigmas[1] {
            patch.sigmas.swap(0, 1);
            patch.quat = frame(axis(patch, 1), axis(patch, 0), axis(patch, 2));
        }
    }
    Ok(())
}

/// ⌊log₂⌋ of a normal number.
fn octave(value: f64) -> i32 {
    (value.to_bits() >> 52 & 0x7ff) as i32 - 1023
}

/// The surfaces around active lines' points whose cells' neighbourhoods span one, with the index of the line. A cell stands
/// for the mean of its points.
fn spans(
    points: &[[f64; 3]],
    lines: &[Line],
    patches: &[Patch],
    octave: i32,
    neighbors: usize,
) -> Vec<(u32, Plane)> {
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
    tree.rows()
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
                            let around = near.iter().map(|n| {
                                let other = n.1 as usize;
                                let first = cells[other][0].1;
                                let patch = &patches[lines[first as usize].at];
                                (means[other], patch, first)
                            });
                            let around: Vec<_> = around.collect();
                            for &(_, i) in cells[cell as usize] {
                                let line = &lines[i as usize];
                                if line.active(octave) {
                                    let here = points[line.row as usize];
                                    let patch = &patches[line.at];
                                    let plane = Plane::of(here, patch, &e, &around, size);
                                    found.extend(plane.map(|p| (i, p)));
                                }
                            }
                        }
                    }
                });
            }
            found
        })
        .collect()
}

/// Axis `c` of a patch: 0 and 1 are tangents, 2 is the normal.
fn axis(patch: &Patch, c: usize) -> [f64; 3] {
    let own = rotation_from_quat(patch.quat);
    [0, 1, 2].map(|r| own[r][c])
}

/// Puts a patch into a plane: along its line narrower, as discs overlap there, and across as wide as the next lines need.
/// The line is axis 0.
fn turn(patch: &mut Patch, plane: &Plane, max_anisotropy: f64) {
    let n = plane.normal;
    if patch.sigmas[1] >= FLAT * patch.sigmas[0] && dot(n, axis(patch, 2)).abs() > TURNED {
        return;
    }
    let along = cross(plane.across, n);
    let narrow = ALONG * patch.sigmas[0];
    let mut wide = ACROSS * plane.gap;
    // Discs that must be longer overlap more, and narrower ones are as opaque midway between lines.
    for _ in 0..4 {
        let overlap = (wide / max_anisotropy / narrow).max(1.0);
        wide = ACROSS * plane.gap / (1.0 + overlap.ln()).sqrt();
    }
    patch.sigmas = [narrow, wide];
    patch.quat = frame(along, plane.across, n);
}

fn frame(t1: [f64; 3], t2: [f64; 3], n: [f64; 3]) -> [f64; 4] {
    quat_from_rotation(&[0, 1, 2].map(|r| [t1[r], t2[r], n[r]]))
}
