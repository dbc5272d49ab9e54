//! A palette of vectors by k-means: rows split top down, then Lloyd's steps among neighbouring entries.

use rayon::prelude::*;

use super::rows::Rows;
use super::{cells, near};
use crate::{Control, Error, Result};

/// Steps between looks at which entries are neighbours.
const RENEWED: usize = 3;
/// Steps end once the share of rows that move is at most one over this; later ones lower the RMSE by a thousandth.
const SETTLED: usize = 100;

/// A palette, and the entry of each row.
#[derive(Debug, Clone, PartialEq)]
pub struct Palette {
    /// Entries × dims.
    pub entries: Vec<f32>,
    /// (N,) rows of `entries`.
    pub labels: Vec<u32>,
}

/// At most `count` entries with a small Σ w |row − entry|², and each row's entry.
///
/// Cells with the most error are split until there are `count`; then `steps` of Lloyd's: rows move to the
/// nearest among their entry and its neighbours, entries to the mean of their rows. Fewer entries come back
/// only where there are fewer distinct rows. Sums are in the order of the rows: the threads decide nothing.
///
/// # Errors
///
/// No rows, rows of another length, values or weights that are not finite, a negative weight, or `count` of
/// 0 or over 65,536.
pub fn palette(
    values: &[f32],
    dims: usize,
    weights: Option<&[f32]>,
    count: usize,
    steps: usize,
    control: &Control,
) -> Result<Palette> {
    refuse!(dims == 0 || values.is_empty() || !values.len().is_multiple_of(dims) =>
        "points", "rows of one length", values.len());
    refuse!(count == 0 || count > 1 << 16 => "count", "1 to 65536", count);
    let points = Rows {
        dims,
        values,
        weights,
    };
    check_weights(weights, points.len())?;
    check_finite("points", values, dims)?;
    control.begin(steps as u64 + 1);
    let (mut entries, mut labels) = cells::split(&points, count.min(points.len()));
    control.advance(1);
    let mut around = Vec::new();
    for step in 0..steps {
        control.check()?;
        if step % RENEWED == 0 {
            around = near::neighbors(&entries, dims);
        }
        let moved = assign(&points, &entries, &around, &mut labels);
        update(&points, &mut entries, &labels);
        control.advance(1);
        if moved <= points.len() / SETTLED {
            break;
        }
    }
    Ok(Palette { entries, labels })
}

/// Assign each row to the nearest of its entry and that entry's neighbours; return the number of rows that changed.
fn assign(points: &Rows, entries: &[f32], around: &[Vec<u32>], labels: &mut [u32]) -> usize {
    let at = |label: u32| &entries[label as usize * points.dims..][..points.dims];
    let move_one = |(row, label): (usize, &mut u32)| {
        let before = *label;
        let mut least = points.distance(row as u32, at(before));
        for &other in &around[before as usize] {
            let far = points.distance(row as u32, at(other));
            if far < least {
                (least, *label) = (far, other);
            }
        }
        usize::from(*label != before)
    };
    let labels = labels.par_iter_mut().enumerate().with_max_len(256);
    labels.map(move_one).sum()
}

/// Move entries to the means of their rows; entries without rows stay.
fn update(points: &Rows, entries: &mut [f32], labels: &[u32]) {
    let mut ends = vec![0_usize; entries.len() / points.dims + 1];
    labels
        .iter()
        .for_each(|&label| ends[label as usize + 1] += 1);
    (1..ends.len()).for_each(|i| ends[i] += ends[i - 1]);
    let (mut members, mut next) = (vec![0_u32; labels.len()], ends.clone());
    for (row, &label) in labels.iter().enumerate() {
        members[next[label as usize]] = row as u32;
        next[label as usize] += 1;
    }
    let move_one = |(label, entry): (usize, &mut [f32])| {
        let rows = &members[ends[label]..ends[label + 1]];
        if !rows.is_empty() {
            entry.copy_from_slice(&points.mean(rows));
        }
    };
    entries
        .par_chunks_mut(points.dims)
        .enumerate()
        .for_each(move_one);
}

pub fn check_weights(weights: Option<&[f32]>, count: usize) -> Result<()> {
    let Some(weights) = weights else {
        return Ok(());
    };
    refuse!(weights.len() != count => "weights", format!("one for each of {count} rows"), weights.len());
    match weights.iter().position(|w| !(w.is_finite() && *w >= 0.0)) {
        Some(row) => {
            let got = format!("{} in row {row}", weights[row]);
            Err(Error::invalid("weights", "finite and not negative", got))
        }
        None => Ok(()),
    }
}

pub fn check_finite(name: &'static str, values: &[f32], dims: usize) -> Result<()> {
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => {
            let got = format!("{} in row {}", values[at], at / dims);
            Err(Error::invalid(name, "finite values", got))
        }
        None => Ok(()),
    }
}
