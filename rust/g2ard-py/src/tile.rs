//! `_core.TileMerging`: simplification of one tile, in steps that all tiles share.

use g2ard_core::simplify::{Frame, Importance, Pairwise, Sums, Tile};
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::arrays;
use crate::constants::Config;
use crate::scene::PyScene;
use crate::simplify::{PyVisibility, outcome_dict};
use crate::work::long;

type Floats<'py> = Bound<'py, PyArray1<f32>>;
type Rows<'py> = Bound<'py, PyArray1<u32>>;

/// Units of measure of all tiles of a scene.
#[pyclass(name = "TileFrame", module = "g2ard._core", frozen, from_py_object)]
#[derive(Clone, Copy)]
pub struct PyFrame(Frame);

#[pymethods]
impl PyFrame {
    /// `importance`: exponent, usual mass, the place's three coordinates, reach and angular share.
    #[new]
    #[pyo3(signature = (unit, pixel_size, floor, even, *importance))]
    fn new(
        unit: f64,
        pixel_size: f32,
        floor: f32,
        even: f32,
        importance: &Bound<'_, PyTuple>,
    ) -> PyResult<Self> {
        let [exponent, usual, x, y, z, reach, angular] = importance.extract()?;
        Ok(Self(Frame {
            unit,
            pixel_size,
            floor,
            even,
            importance: Importance {
                exponent,
                usual,
                place: [x, y, z],
                reach,
                angular,
            },
        }))
    }

    /// The frame of a fair sample of a scene, without views.
    #[staticmethod]
    fn of_sample(py: Python<'_>, scene: &PyScene, config: Config<Pairwise>) -> PyResult<Self> {
        let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
        let scene = splats.borrow()?;
        let frame = long(py, None, |_| {
            Ok(Frame::of_sample(&config.0, &scene, ordered))
        })?;
        Ok(Self(frame))
    }

    /// The frame with views: the usual size of a pixel, and `sums` added up over all tiles.
    fn with_views(&self, pixel_size: f32, weight: f64, mass: f64, per_pixel: f64) -> Self {
        let sums = Sums {
            weight,
            mass,
            per_pixel,
        };
        Self(self.0.with_views(pixel_size, sums))
    }

    /// The arguments of the constructor.
    fn values(&self) -> Vec<f64> {
        let Frame {
            unit,
            pixel_size,
            floor,
            even,
            importance,
        } = self.0;
        let [x, y, z] = importance.place;
        let of_scene = [unit, pixel_size.into(), floor.into(), even.into()];
        let of_rows = [importance.exponent, importance.usual];
        let of_place = [x, y, z, importance.reach, importance.angular];
        [&of_scene[..], &of_rows, &of_place].concat()
    }
}

#[pyclass(name = "TileMerging", module = "g2ard._core", frozen)]
pub struct PyTileMerging {
    scene: Py<PyScene>,
    visibility: Option<Py<PyAny>>,
    policy: Pairwise,
    frame: Frame,
}

impl PyTileMerging {
    fn with<T>(&self, py: Python<'_>, work: impl FnOnce(&Tile) -> PyResult<T>) -> PyResult<T> {
        let scene = self.scene.get();
        let splats = scene.splats(py)?;
        let rows = splats.borrow()?;
        let seen = self.visibility.as_ref().map(|seen| seen.extract(py));
        let seen: Option<PyVisibility<'_>> = seen.transpose()?;
        let visibility = seen.as_ref().map(PyVisibility::borrow).transpose()?;
        work(&Tile {
            policy: self.policy,
            scene: &rows,
            ordered: &scene.ordered,
            visibility,
            frame: self.frame,
        })
    }
}

#[pymethods]
impl PyTileMerging {
    #[new]
    #[pyo3(signature = (scene, frame, config, visibility=None))]
    fn new(
        scene: Py<PyScene>,
        frame: PyFrame,
        config: Config<Pairwise>,
        visibility: Option<Py<PyAny>>,
    ) -> Self {
        Self {
            scene,
            visibility,
            policy: config.0,
            frame: frame.0,
        }
    }

    /// Return sums over the kept rows: Σ αT² of the views, mass, and Σ αT² per pixel.
    fn sums(&self, py: Python<'_>) -> PyResult<(f64, f64, f64)> {
        let sums = self.with(py, |tile| long(py, None, |_| tile.sums()))?;
        Ok((sums.weight, sums.mass, sums.per_pixel))
    }

    /// Return the cost of closing each gap between neighbours in Morton order, from the first kept row on, for runs of
    /// `mean_run` rows in the mean over all tiles.
    fn run_costs<'py>(&self, py: Python<'py>, mean_run: f64) -> PyResult<Floats<'py>> {
        let costs = self.with(py, |tile| long(py, None, |_| tile.run_costs(mean_run)))?;
        Ok(PyArray1::from_vec(py, costs))
    }

    /// Return the run of each row in the scene's order, or 2³² − 1, and merges `a`, `b` of runs with their costs.
    #[pyo3(signature = (runs, schedule, costs, progress=None))]
    fn plan<'py>(
        &self,
        py: Python<'py>,
        runs: usize,
        schedule: Vec<usize>,
        costs: PyReadonlyArray1<'py, f32>,
        progress: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<(Rows<'py>, Rows<'py>, Rows<'py>, Floats<'py>)> {
        let costs = arrays::flat("costs", &costs)?;
        let plan = self.with(py, |tile| {
            long(py, progress, |control| {
                tile.plan(runs, &schedule, costs, control)
            })
        })?;
        let names =
            |of: fn(&g2ard_core::simplify::Pair) -> u32| plan.merges.iter().map(of).collect();
        let (a, b) = (names(|p| p.a), names(|p| p.b));
        let costs = plan.merges.iter().map(|p| p.cost).collect();
        Ok((
            PyArray1::from_vec(py, plan.run_of),
            PyArray1::from_vec(py, a),
            PyArray1::from_vec(py, b),
            PyArray1::from_vec(py, costs),
        ))
    }

    /// Return the Gaussians of a partition into `count` clusters, like `simplify_pairwise`.
    #[pyo3(signature = (of, count, progress=None))]
    fn assemble<'py>(
        &self,
        py: Python<'py>,
        of: PyReadonlyArray1<'py, u32>,
        count: usize,
        progress: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let of = arrays::flat("of", &of)?.to_vec();
        let outcome = self.with(py, |tile| {
            long(py, progress, |control| tile.assemble(of, count, control))
        })?;
        outcome_dict(py, outcome, Vec::new())
    }
}
