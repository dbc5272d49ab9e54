//! Codebooks and palettes of file formats.

use g2ard_core::quantize::{codebook as numbers, palette as vectors};
use numpy::{
    PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays;
use crate::work::{long, quick};

/// Return (count,) ascending numbers with the least Σ w (v − nearest)²; the last one repeats if fewer suffice.
#[pyfunction]
#[pyo3(signature = (values, count, weights=None))]
pub fn codebook<'py>(
    py: Python<'py>,
    values: PyReadonlyArray1<'py, f32>,
    count: usize,
    weights: Option<PyReadonlyArray1<'py, f32>>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let values = arrays::flat("values", &values)?;
    let weights = arrays::optional("weights", &weights)?;
    let found = quick(py, || numbers(values, weights, count))?;
    Ok(PyArray1::from_vec(py, found))
}

type Found<'py> = (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray1<u32>>);

/// Return (K, D) entries, K at most `count`, and (N,) the entry of each row of (N, D), by k-means.
#[pyfunction]
#[pyo3(signature = (points, count, steps, weights=None, progress=None))]
pub fn palette<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f32>,
    count: usize,
    steps: usize,
    weights: Option<PyReadonlyArray1<'py, f32>>,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Found<'py>> {
    let dims = points.shape()[1];
    let values = arrays::flat("points", &points)?;
    let weights = arrays::optional("weights", &weights)?;
    let found = long(py, progress.as_ref(), |control| {
        vectors(values, dims, weights, count, steps, control)
    })?;
    let rows = found.entries.len() / dims;
    let entries = PyArray1::from_vec(py, found.entries).reshape([rows, dims])?;
    Ok((entries, PyArray1::from_vec(py, found.labels)))
}
