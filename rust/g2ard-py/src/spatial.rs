//! Exact nearest neighbours; rays through cells.

use g2ard_core::spatial::{Steps, Tree};
use g2ard_core::{Control, Result};
use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use rayon::prelude::*;

use crate::arrays;
use crate::error::invalid;
use crate::work::{long, quick};

/// Return (N, k) rows of the points nearest to each of (N, 3) finite points, without itself, by (distance, row).
#[pyfunction]
#[pyo3(signature = (points, k, progress=None))]
pub fn knn<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    k: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray2<u32>>> {
    let points = arrays::rows::<f64, 3>("points", &points)?;
    if k == 0 || k >= points.len() {
        let wanted = format!("1 to {}", points.len().saturating_sub(1));
        return Err(invalid("k", wanted, k));
    }
    if let Some(row) = points.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        let got = format!("{:?} in row {row}", points[row]);
        return Err(invalid("points", "finite coordinates", got));
    }
    let near = long(py, progress, |control| neighbors(points, k, control))?;
    Ok(near.into_pyarray(py))
}

fn neighbors(points: &[[f64; 3]], k: usize, control: &Control) -> Result<Array2<u32>> {
    const CHUNK: usize = 1024;
    control.begin(points.len() as u64);
    let tree = Tree::build(points);
    let mut found = vec![0; points.len() * k];
    let chunks = found.par_chunks_mut(CHUNK * k).enumerate();
    chunks.try_for_each(|(chunk, found)| {
        control.check()?;
        let range = chunk * CHUNK..points.len().min((chunk + 1) * CHUNK);
        let mut rows = found.chunks_mut(k);
        tree.nearest(range, k, |_, near| {
            let row = rows.next().into_iter().flatten();
            row.zip(near).for_each(|(to, n)| *to = n.1);
        });
        control.advance((found.len() / k) as u64);
        Ok(())
    })?;
    let mut rows = Array2::zeros((points.len(), k));
    for (&row, near) in tree.rows().iter().zip(found.chunks(k)) {
        let to = rows.row_mut(row as usize);
        to.into_iter().zip(near).for_each(|(to, from)| *to = *from);
    }
    Ok(rows)
}

/// Return (M,) distances at which unit rays first meet a cell of 0 steps; infinite if they meet none.
#[pyfunction]
pub fn cast_rays<'py>(
    py: Python<'py>,
    steps: PyReadonlyArray1<'py, i8>,
    shape: [usize; 3],
    low: [f64; 3],
    cell: f64,
    eyes: PyReadonlyArray2<'py, f64>,
    directions: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let steps = Steps {
        low,
        cell,
        shape,
        steps: arrays::flat("steps", &steps)?,
    };
    let eyes = arrays::rows::<f64, 3>("eyes", &eyes)?;
    let directions = arrays::rows::<f64, 3>("directions", &directions)?;
    let found = quick(py, || steps.cast(eyes, directions))?;
    Ok(PyArray1::from_vec(py, found))
}
