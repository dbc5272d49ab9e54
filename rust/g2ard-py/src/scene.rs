//! `_core.Scene`: a scene that stages share, ordered once.

use std::sync::Arc;

use g2ard_core::scene::{Means, Ordered, SceneRef};
use g2ard_core::spatial::RobustBounds;
use numpy::{
    PyArray1, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays;
use crate::work::long;

/// Means as float32 or float64.
#[derive(FromPyObject)]
enum PyMeans<'py> {
    F32(PyReadonlyArray2<'py, f32>),
    F64(PyReadonlyArray2<'py, f64>),
}

/// The six arrays of a `g2ard.Splats`.
#[derive(FromPyObject)]
pub struct PySplats<'py> {
    means: PyMeans<'py>,
    quats: PyReadonlyArray2<'py, f32>,
    scales: PyReadonlyArray2<'py, f32>,
    logit_opacities: PyReadonlyArray1<'py, f32>,
    sh0: PyReadonlyArray3<'py, f32>,
    #[pyo3(attribute("shN"))]
    sh_rest: PyReadonlyArray3<'py, f32>,
}

impl PySplats<'_> {
    pub fn borrow(&self) -> PyResult<SceneRef<'_>> {
        Ok(SceneRef {
            means: match &self.means {
                PyMeans::F32(m) => Means::F32(arrays::rows("means", m)?),
                PyMeans::F64(m) => Means::F64(arrays::rows("means", m)?),
            },
            quats: arrays::rows("quats", &self.quats)?,
            scales: arrays::rows("scales", &self.scales)?,
            logit_opacities: arrays::flat("logit_opacities", &self.logit_opacities)?,
            sh0: arrays::rows("sh0", &self.sh0)?,
            sh_rest: arrays::rows("shN", &self.sh_rest)?,
            rest: self.sh_rest.shape()[1],
        })
    }
}

/// A `g2ard.Splats` and its order. The arrays must not change while it exists.
#[pyclass(name = "Scene", module = "g2ard._core", frozen)]
pub struct PyScene {
    splats: Py<PyAny>,
    pub ordered: Arc<Ordered>,
}

impl PyScene {
    /// The arrays, borrowed while the result is alive.
    pub fn splats<'py>(&self, py: Python<'py>) -> PyResult<PySplats<'py>> {
        self.splats.bind(py).extract()
    }
}

#[pymethods]
impl PyScene {
    /// `known`: `order` and `bounds` of the same scene, computed before.
    #[new]
    #[pyo3(signature = (splats, known = None))]
    fn new(
        py: Python<'_>,
        splats: &Bound<'_, PyAny>,
        known: Option<(PyReadonlyArray1<'_, u32>, [f64; 4])>,
    ) -> PyResult<Self> {
        let rows: PySplats<'_> = splats.extract()?;
        let scene = rows.borrow()?;
        let known = match known {
            Some((order, [x, y, z, radius])) => {
                let origin = [x, y, z];
                Some((
                    arrays::flat("order", &order)?.to_vec(),
                    RobustBounds { origin, radius },
                ))
            }
            None => None,
        };
        let ordered = long(py, None, |_| match known {
            Some((order, bounds)) => Ordered::restored(&scene, order, bounds),
            None => Ordered::new(&scene),
        })?;
        Ok(Self {
            splats: splats.clone().unbind(),
            ordered: Arc::new(ordered),
        })
    }

    /// The scene's median point.
    #[getter]
    fn origin(&self) -> [f64; 3] {
        self.ordered.bounds.origin
    }

    /// The median point, and the radius of the cube around it that Morton codes divide.
    #[getter]
    fn bounds(&self) -> [f64; 4] {
        let [x, y, z] = self.ordered.bounds.origin;
        [x, y, z, self.ordered.bounds.radius]
    }

    /// (N,) rows in the order that only the scene's content decides.
    #[getter]
    fn order<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_slice(py, &self.ordered.rows)
    }
}
