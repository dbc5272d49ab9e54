//! `_core.VisibilityAccumulator`: what views see of a scene, view by view.

use g2ard_core::visibility::VisibilityAccumulator;
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::scene::PyScene;
use crate::views::{RasterOptions, View};
use crate::work::long;

#[pyclass(name = "VisibilityAccumulator", module = "g2ard._core")]
struct PyVisibilityAccumulator(VisibilityAccumulator);

#[pymethods]
impl PyVisibilityAccumulator {
    #[new]
    fn new(py: Python<'_>, scene: &PyScene) -> PyResult<Self> {
        let splats = scene.splats(py)?;
        let (rows, ordered) = (splats.borrow()?, scene.ordered.clone());
        long(py, None, |_| VisibilityAccumulator::new(&rows, ordered)).map(Self)
    }

    /// Adds views; returns how many rows have been seen so far.
    #[pyo3(signature = (views, options, progress = None))]
    fn add(
        &mut self,
        py: Python<'_>,
        views: Vec<View>,
        options: RasterOptions,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<usize> {
        let settings = options.settings()?;
        let accumulator = &mut self.0;
        long(py, progress, |control| {
            control.begin(views.len() as u64);
            for view in &views {
                control.check()?;
                accumulator.add(&view.camera(), &settings)?;
                control.advance(1);
            }
            Ok(accumulator.seen())
        })
    }

    /// (N,) Σ αT and (N,) the smallest size of a pixel, ∞ where no view contains the mean.
    fn by_row<'py>(
        &self,
        py: Python<'py>,
    ) -> (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>) {
        let (weight, pixel_size) = self.0.by_row();
        (
            PyArray1::from_vec(py, weight),
            PyArray1::from_vec(py, pixel_size),
        )
    }
}

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyVisibilityAccumulator>()
}
