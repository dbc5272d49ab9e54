//! Rows split into cells, always the cell with the most error: the start of a palette.

use rayon::prelude::*;

use super::rows::Rows;

/// Steps of 2-means after a cut.
const STEPS: usize = 4;

/// Some rows, their weighted mean, and Σ w |row − mean|².
struct Cell {
    rows: Vec<u32>,
    mean: Vec<f32>,
    error: f64,
}

impl Cell {
    fn of(points: &Rows, rows: Vec<u32>) -> Self {
        let mean = points.mean(&rows);
        let error = rows
            .iter()
            .map(|&r| points.weight(r) * f64::from(points.distance(r, &mean)))
            .sum();
        Self { rows, mean, error }
    }
}

/// At most `count` means, and the cell of every row. Cells near each other have near numbers.
pub fn split(points: &Rows, count: usize) -> (Vec<f32>, Vec<u32>) {
    let mut cells = vec![Cell::of(points, (0..points.len() as u32).collect())];
    loop {
        let mut chosen = worst(&cells, count - cells.len());
        if chosen.is_empty() {
            break;
        }
        chosen.sort_unstable();
        let halves: Vec<Option<[Cell; 2]>> = chosen
            .par_iter()
            .map(|&at| halved(points, &cells[at]))
            .collect();
        let mut next = Vec::with_capacity(cells.len() + chosen.len());
        let mut halves = chosen.into_iter().zip(halves).peekable();
        for (at, mut cell) in cells.into_iter().enumerate() {
            match halves.next_if(|(chosen, _)| *chosen == at) {
                Some((_, Some(two))) => next.extend(two),
                Some((_, None)) => {
                    cell.error = 0.0; // what float32 cannot part
                    next.push(cell);
                }
                None => next.push(cell),
            }
        }
        cells = next;
    }
    let mut labels = vec![0; points.len()];
    for (label, cell) in cells.iter().enumerate() {
        cell.rows
            .iter()
            .for_each(|&row| labels[row as usize] = label as u32);
    }
    (
        cells.into_iter().flat_map(|cell| cell.mean).collect(),
        labels,
    )
}

/// The cells with at least the mean error, the worst `most` of them.
fn worst(cells: &[Cell], most: usize) -> Vec<usize> {
    let total: f64 = cells.iter().map(|cell| cell.error).sum();
    let least = total / cells.len() as f64 * (1.0 - 1e-9);
    let mut found: Vec<usize> = (0..cells.len())
        .filter(|&i| cells[i].error > 0.0 && cells[i].error >= least)
        .collect();
    found.sort_by(|&a, &b| cells[b].error.total_cmp(&cells[a].error).then(a.cmp(&b)));
    found.truncate(most);
    found
}

/// Cut at the mean of the coordinate that varies most, then moved by a few steps of 2-means.
fn halved(points: &Rows, cell: &Cell) -> Option<[Cell; 2]> {
    let mut variance = vec![0.0_f64; points.dims];
    for &row in &cell.rows {
        let weight = points.weight(row);
        for (sum, (v, m)) in variance
            .iter_mut()
            .zip(points.row(row).iter().zip(&cell.mean))
        {
            *sum += weight * f64::from(v - m) * f64::from(v - m);
        }
    }
    let axis =
        (0..points.dims).max_by(|&a, &b| variance[a].total_cmp(&variance[b]).then(b.cmp(&a)))?;
    let cut = |&row: &u32| points.row(row)[axis] <= cell.mean[axis];
    let mut sides: (Vec<u32>, Vec<u32>) = cell.rows.iter().partition(|&row| cut(row));
    for _ in 0..STEPS {
        if sides.0.is_empty() || sides.1.is_empty() {
            return None;
        }
        let (a, b) = (points.mean(&sides.0), points.mean(&sides.1));
        let nearer = |&row: &u32| points.distance(row, &a) <= points.distance(row, &b);
        let next: (Vec<u32>, Vec<u32>) = cell.rows.iter().partition(|&row| nearer(row));
        if next.0.is_empty() || next.1.is_empty() || next.0 == sides.0 {
            break;
        }
        sides = next;
    }
    Some([Cell::of(points, sides.0), Cell::of(points, sides.1)])
}
