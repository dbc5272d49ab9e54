//! numpy ↔ slices of fixed-size rows, without copying.

use numpy::ndarray::Dimension;
use numpy::{
    Element, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray, PyReadwriteArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::error::invalid;

/// A C-contiguous array whose last axes hold `C` values, as rows of `C`.
pub fn rows<'a, T: Element, const C: usize>(
    name: &'static str,
    array: &'a PyReadonlyArray<'_, T, impl Dimension>,
) -> PyResult<&'a [[T; C]]> {
    let flat = flat(name, array)?;
    let (rows, left) = flat.as_chunks::<C>();
    if left.is_empty() {
        Ok(rows)
    } else {
        let got = format!("{:?}", array.shape());
        Err(invalid(name, format!("rows of {C}"), got))
    }
}

/// A C-contiguous array as one slice.
pub fn flat<'a, T: Element>(
    name: &'static str,
    array: &'a PyReadonlyArray<'_, T, impl Dimension>,
) -> PyResult<&'a [T]> {
    let strided = |_| invalid(name, "a C-contiguous array", "strides");
    array.as_slice().map_err(strided)
}

/// An array that may be absent, as one slice.
pub fn optional<'a, T: Element>(
    name: &'static str,
    array: &'a Option<PyReadonlyArray<'_, T, impl Dimension>>,
) -> PyResult<Option<&'a [T]>> {
    array.as_ref().map(|array| flat(name, array)).transpose()
}

/// A C-contiguous array as one slice to write to.
pub fn writable<'a>(
    name: &'static str,
    array: &'a mut PyReadwriteArrayDyn<'_, f32>,
) -> PyResult<&'a mut [f32]> {
    let strided = |_| invalid(name, "a C-contiguous array", "strides");
    array.as_slice_mut().map_err(strided)
}

/// Rows as an (N, C) array; the memory moves, nothing is copied.
pub fn matrix<'py, T: Element, const C: usize>(
    py: Python<'py>,
    rows: Vec<[T; C]>,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let n = rows.len();
    PyArray1::from_vec(py, rows.into_flattened()).reshape([n, C])
}
