//! `_core.Trainer`: whole recovery steps in Rust.

use g2ard_core::raster::{Camera, Settings};
use g2ard_core::train::{
    Attribute, Biases, Exported, Part, Rates, Regularizers, StepInput, Train, TrainKernels,
    Trainer, step_rows,
};
use g2ard_core::{Error, Result};
use numpy::{
    IntoPyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyReadwriteArray1, PyReadwriteArrayDyn,
};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};
use std::sync::{Mutex, PoisonError};

use crate::arrays::{flat, optional, writable};
use crate::constants::Config;
use crate::device::{kernels, stop_training};
use crate::error::{invalid, to_py};
use crate::raster::{Arrays, Floats, isa_named};
use crate::views::{RasterOptions, View};
use crate::work;

/// A `g2ard.stages.recover.config.Rates`.
#[derive(FromPyObject)]
struct PyRates {
    means: f32,
    quats: f32,
    log_scales: f32,
    logit_opacities: f32,
    sh0: f32,
    #[pyo3(attribute("shN"))]
    sh_n: f32,
    /// Share of the longer side of a view.
    reach: f64,
    /// Pixels.
    finest: f32,
    momentum: f32,
}

impl PyRates {
    /// The reach in pixels of a view.
    fn reach_in(&self, camera: &Camera) -> Option<f32> {
        let pixels = self.reach * camera.width.max(camera.height) as f64;
        (self.reach != f64::INFINITY).then_some(pixels as f32)
    }
}

impl From<PyRates> for Rates {
    fn from(rates: PyRates) -> Self {
        Self {
            means: rates.means,
            quats: rates.quats,
            log_scales: rates.log_scales,
            logit_opacities: rates.logit_opacities,
            sh0: rates.sh0,
            sh_n: rates.sh_n,
            momentum: rates.momentum,
        }
    }
}

/// The attributes of a `g2ard.stages.recover.engine.Objective` that are equal in all steps.
#[derive(FromPyObject)]
struct PyObjective {
    settings: RasterOptions,
    background: [f32; 3],
    ssim_weight: f32,
}

/// Calls from several threads take turns.
#[pyclass(name = "Trainer", module = "g2ard._core", frozen)]
pub struct PyTrainer {
    trained: Mutex<Trained>,
    settings: Settings,
    background: [f32; 3],
    ssim_weight: f32,
}

struct Trained {
    inner: Box<dyn Train>,
    rows: usize,
    sh_coeffs: usize,
    skipped: usize,
}

/// Let the CPU train from now on if the error is a device's.
fn noted<T>(result: Result<T>) -> Result<T> {
    if let Err(Error::Device(why)) = &result {
        stop_training(why);
    }
    result
}

impl PyTrainer {
    /// A step without rates.
    fn input<'a>(&self, camera: &'a Camera, target: &'a [f32]) -> StepInput<'a> {
        StepInput {
            camera,
            settings: self.settings,
            background: self.background,
            target,
            mask: None,
            view: None,
            ssim_weight: self.ssim_weight,
            relative: None,
            rates: Rates::default(),
            reach: None,
            finest: 0.0,
            regularizers: None,
        }
    }
}

#[pymethods]
impl PyTrainer {
    /// A trainer on the device in use, or on the CPU with the instruction set `isa`.
    #[new]
    #[pyo3(signature = (arrays, objective, units = None, isa = None))]
    fn new(
        py: Python<'_>,
        arrays: Arrays<'_>,
        objective: PyObjective,
        units: Option<Floats<'_>>,
        isa: Option<&str>,
    ) -> PyResult<Self> {
        let isa = isa.map(|name| isa_named(Some(name))).transpose()?;
        let units = optional("units", &units)?;
        let params = arrays.params()?;
        let inner = work::quick(py, || match isa {
            Some(isa) => Ok(Box::new(Trainer::new(&params, units, isa)?) as Box<dyn Train>),
            None => kernels().trainer(&params, units),
        })?;
        let trained = Trained {
            inner,
            rows: params.len(),
            sh_coeffs: params.sh_coeffs,
            skipped: 0,
        };
        Ok(Self {
            trained: Mutex::new(trained),
            settings: objective.settings.settings()?,
            background: objective.background,
            ssim_weight: objective.ssim_weight,
        })
    }

    /// Freeze the anchors: means (N, 3), frames (N, 3, 3) with columns t1, t2, n, and the two radii (N,).
    fn anchor(
        &self,
        py: Python<'_>,
        means: Floats<'_>,
        frames: Floats<'_>,
        r_parallel: Floats<'_>,
        r_perp: Floats<'_>,
    ) -> PyResult<()> {
        let (means, frames) = (
            flat("anchor means", &means)?,
            flat("anchor frames", &frames)?,
        );
        let (r_parallel, r_perp) = (flat("r_parallel", &r_parallel)?, flat("r_perp", &r_perp)?);
        work::locked(py, &self.trained)
            .inner
            .set_anchors(means, frames, r_parallel, r_perp)
            .or_else(|error| noted(Err(error)))
            .map_err(to_py)
    }

    /// Freeze rows, given as an (N,) mask: no step changes them.
    fn freeze(&self, py: Python<'_>, frozen: PyReadonlyArray1<'_, bool>) -> PyResult<()> {
        let frozen = flat("frozen", &frozen)?;
        let mut trained = work::locked(py, &self.trained);
        noted(trained.inner.freeze(frozen)).map_err(to_py)
    }

    /// Take one step; return (photometric loss before it, Gaussians moved). `mask`: where the loss counts. `number`: of a
    /// view whose target and mask are the same in all steps.
    #[pyo3(signature = (view, target, rates, regularizers = None, mask = None, relative = None, number = None))]
    #[expect(clippy::too_many_arguments, reason = "Python's signature")]
    fn step(
        &self,
        py: Python<'_>,
        view: View,
        target: PyReadonlyArray3<'_, f32>,
        rates: PyRates,
        regularizers: Option<Config<Regularizers>>,
        mask: Option<PyReadonlyArray2<'_, bool>>,
        relative: Option<f32>,
        number: Option<u32>,
    ) -> PyResult<(f64, usize)> {
        let camera = view.camera();
        let target = flat("target", &target)?;
        let input = StepInput {
            mask: optional("mask", &mask)?,
            view: number,
            relative,
            reach: rates.reach_in(&camera),
            finest: rates.finest,
            rates: rates.into(),
            regularizers: regularizers.map(|r| r.0),
            ..self.input(&camera, target)
        };
        let mut trained = work::locked(py, &self.trained);
        let inner = &mut trained.inner;
        let report = work::quick(py, || noted(inner.step(&input)))?;
        trained.skipped += report.skipped;
        Ok((report.loss, report.updated))
    }

    /// Return the six parameter arrays, rows in the caller's order.
    fn arrays<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyArrayDyn<f32>>>> {
        let trained = work::locked(py, &self.trained);
        let (n, rest) = (trained.rows, trained.sh_coeffs - 1);
        let shapes = [
            vec![n, 3],
            vec![n, 4],
            vec![n, 3],
            vec![n],
            vec![n, 1, 3],
            vec![n, rest, 3],
        ];
        let starts = [0, 3, 7, 10, 11, 14, 14 + 3 * rest];
        let columns = work::quick(py, || noted(trained.inner.columns(&starts)))?;
        (columns.into_iter().zip(shapes))
            .map(|(values, shape)| PyArray1::from_vec(py, values).reshape(shape))
            .collect()
    }

    /// Return the number of steps that each row has taken, (N,).
    fn steps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u32>>> {
        let trained = work::locked(py, &self.trained);
        let steps = work::quick(py, || noted(trained.inner.steps()))?;
        Ok(steps.into_pyarray(py))
    }

    /// Return everything that a bitwise resume needs: a dict of arrays; or only "values", "first" or "second", where the
    /// other arrays are empty, or the "rest".
    #[pyo3(signature = (part = None))]
    fn state<'py>(&self, py: Python<'py>, part: Option<&str>) -> PyResult<Bound<'py, PyDict>> {
        let part = match part {
            None => None,
            Some("values") => Some(Part::Values),
            Some("first") => Some(Part::First),
            Some("second") => Some(Part::Second),
            Some("rest") => Some(Part::Rest),
            Some(other) => return Err(invalid("part", "values, first, second or rest", other)),
        };
        let trained = work::locked(py, &self.trained);
        let state = work::quick(py, || {
            noted(match part {
                None => trained.inner.export(),
                Some(part) => trained.inner.export_part(part),
            })
        })?;
        let dict = [
            ("values", state.values.into_pyarray(py)),
            ("first", state.first.into_pyarray(py)),
            ("second", state.second.into_pyarray(py)),
            ("units", state.units.into_pyarray(py)),
        ]
        .into_py_dict(py)?;
        dict.set_item("steps", state.steps.into_pyarray(py))?;
        dict.set_item("order", state.order.into_pyarray(py))?;
        Ok(dict)
    }

    /// Restore a `state`, whose arrays leave the dict one by one to free their memory; anchors must be set again.
    fn load(&self, py: Python<'_>, state: &Bound<'_, PyDict>) -> PyResult<()> {
        let state = Exported {
            values: take(state, "values")?,
            first: take(state, "first")?,
            second: take(state, "second")?,
            units: take(state, "units")?,
            steps: take(state, "steps")?,
            order: take(state, "order")?,
        };
        let mut trained = work::locked(py, &self.trained);
        noted(trained.inner.import(&state)).map_err(to_py)
    }

    /// Number of Gaussian steps skipped since the start because a gradient was not finite.
    #[getter]
    fn skipped(&self, py: Python<'_>) -> usize {
        work::locked(py, &self.trained).skipped
    }
}

/// Take an array out of a dict.
fn take<T: numpy::Element + Clone>(
    state: &Bound<'_, PyDict>,
    name: &'static str,
) -> PyResult<Vec<T>> {
    let missing = || invalid(name, "an array in the state", "none");
    let value = state.get_item(name)?.ok_or_else(missing)?;
    let array: PyReadonlyArray1<'_, T> = value.extract()?;
    let values = array.as_array().to_vec();
    state.del_item(name)?;
    Ok(values)
}

/// One attribute of `adam_rows`: values, first and second moments, gradients, rate, and factors of the rate.
#[derive(FromPyObject)]
pub struct PyAttribute<'py>(
    PyReadwriteArrayDyn<'py, f32>,
    PyReadwriteArrayDyn<'py, f32>,
    PyReadwriteArrayDyn<'py, f32>,
    Floats<'py>,
    f32,
    Option<Floats<'py>>,
);

impl PyAttribute<'_> {
    fn attribute(&mut self) -> PyResult<Attribute<'_>> {
        Ok(Attribute {
            values: writable("values", &mut self.0)?,
            first: writable("first moments", &mut self.1)?,
            second: writable("second moments", &mut self.2)?,
            gradients: flat("gradients", &self.3)?,
            rate: self.4,
            share: optional("shares", &self.5)?,
        })
    }
}

/// Take an Adam step in place with each row that has a gradient, with β₁ = `momentum`; return the number of rows skipped.
#[pyfunction]
pub fn adam_rows(
    py: Python<'_>,
    attributes: Vec<PyAttribute<'_>>,
    mut counts: PyReadwriteArray1<'_, i64>,
    momentum: f32,
) -> PyResult<usize> {
    /// What earlier calls worked out. Locked only with the GIL held: see `work::POOL`.
    static BIASES: Mutex<Option<Biases>> = Mutex::new(None);
    let kept = || BIASES.lock().unwrap_or_else(PoisonError::into_inner);
    let mut attributes = attributes;
    let mut all = (attributes.iter_mut())
        .map(PyAttribute::attribute)
        .collect::<PyResult<Vec<_>>>()?;
    let counts = (counts.as_slice_mut())
        .map_err(|_| invalid("counts", "a C-contiguous array", "strides"))?;
    let mut biases = kept().take().unwrap_or_default();
    let skipped = work::quick(py, || step_rows(&mut all, counts, momentum, &mut biases));
    *kept() = Some(biases);
    skipped
}
