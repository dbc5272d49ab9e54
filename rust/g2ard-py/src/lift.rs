//! `g2ard.stages.lift`.

use g2ard_core::lift::{LiftConfig, lift};
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::arrays;
use crate::constants::Config;
use crate::work::long;

type Discs<'py> = (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>);

/// Return (quats, scales) of the discs of centred (N, 3) points.
#[pyfunction]
#[pyo3(signature = (points, config, progress=None))]
pub fn lift_points<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    config: Config<LiftConfig>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Discs<'py>> {
    let points = arrays::rows::<f64, 3>("points", &points)?;
    let discs = long(py, progress, |control| lift(points, &config.0, control))?;
    Ok((
        arrays::matrix(py, discs.quats)?,
        arrays::matrix(py, discs.scales)?,
    ))
}
