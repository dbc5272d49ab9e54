//! `_core.VisibilityAccumulator`: visibility of a scene, summed view by view.

use std::sync::{Arc, Mutex};

use g2ard_core::raster::visibility::{VisibilityAccumulator, VisibilityKernels};
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::device::{Kernels, kernels};
use crate::scene::PyScene;
use crate::views::{RasterOptions, View};
use crate::work::{locked, long};

/// Calls from several threads take turns.
#[pyclass(name = "VisibilityAccumulator", module = "g2ard._core", frozen)]
pub struct PyVisibilityAccumulator {
    sums: Mutex<VisibilityAccumulator>,
    /// The kernels chosen when it was created.
    kernels: Arc<Kernels>,
}

#[pymethods]
impl PyVisibilityAccumulator {
    #[new]
    fn new(py: Python<'_>, scene: &PyScene) -> PyResult<Self> {
        let splats = scene.splats(py)?;
        let (rows, ordered) = (splats.borrow()?, scene.ordered.clone());
        let sums = long(py, None, |_| VisibilityAccumulator::new(&rows, ordered))?;
        let kernels = kernels();
        Ok(Self {
            sums: Mutex::new(sums),
            kernels,
        })
    }

    /// Add views; return how many rows have been seen so far.
    #[pyo3(signature = (views, options, progress = None))]
    fn add(
        &self,
        py: Python<'_>,
        views: Vec<View>,
        options: RasterOptions,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<usize> {
        let settings = options.settings()?;
        let mut sums = locked(py, &self.sums);
        let (sums, kernels) = (&mut *sums, &self.kernels);
        let cameras: Vec<_> = views.iter().map(View::camera).collect();
        long(py, progress, |control| {
            kernels.add_views(sums, &cameras, &settings, control)?;
            Ok(sums.seen())
        })
    }

    /// Return (N,) Σ αT² and (N,) the smallest size of a pixel, ∞ if no view contains the mean.
    fn by_row<'py>(
        &self,
        py: Python<'py>,
    ) -> (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>) {
        let (weight, pixel_size) = locked(py, &self.sums).by_row();
        (
            PyArray1::from_vec(py, weight),
            PyArray1::from_vec(py, pixel_size),
        )
    }
}
