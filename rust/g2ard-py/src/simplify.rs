//! `g2ard.stages.simplify`.

use g2ard_core::simplify::{
    Look, Means, Ordered, Outcome, Pairwise, PairwiseRound, Paper, PaperRound, SceneRef, Seen,
    Texture, flags,
};
use numpy::{
    PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays;
use crate::device::{backend, kernels};
use crate::raster::{Choices, View};
use crate::work::long;

/// Means in whichever float the caller holds them.
#[derive(FromPyObject)]
enum PyMeans<'py> {
    F32(PyReadonlyArray2<'py, f32>),
    F64(PyReadonlyArray2<'py, f64>),
}

/// The six arrays of a `g2ard.Splats`.
#[derive(FromPyObject)]
struct PyScene<'py> {
    means: PyMeans<'py>,
    quats: PyReadonlyArray2<'py, f32>,
    scales: PyReadonlyArray2<'py, f32>,
    logit_opacities: PyReadonlyArray1<'py, f32>,
    sh0: PyReadonlyArray3<'py, f32>,
    #[pyo3(attribute("shN"))]
    sh_rest: PyReadonlyArray3<'py, f32>,
}

impl PyScene<'_> {
    fn borrow(&self) -> PyResult<SceneRef<'_>> {
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

/// `protected` (N,) bool of the raw prior over about `cells` cells.
#[pyfunction]
#[pyo3(signature = (scene, cells, *, threshold, members, progress=None))]
fn simplify_flags<'py>(
    py: Python<'py>,
    scene: PyScene<'py>,
    cells: usize,
    threshold: f64,
    members: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let scene = scene.borrow()?;
    let texture = Texture { threshold, members };
    let kernels = kernels();
    let found = long(py, progress, |control| {
        let ordered = Ordered::new(&scene)?;
        let splats = ordered.splats(&scene);
        let found = flags(&splats, cells, texture, backend(&kernels), control)?;
        let mut by_row = vec![false; found.len()];
        for (&row, &flag) in ordered.rows.iter().zip(&found) {
            by_row[row as usize] = flag;
        }
        Ok(by_row)
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// The paper's rounds, down to each count of `schedule`, over about `cells` cells each.
#[pyfunction]
#[pyo3(signature = (
    scene, schedule, cells, *, protected, min_opacity, color_bin, max_energy, min_coverage, support,
    flag_threshold, flag_members, protection, progress=None
))]
fn simplify_paper<'py>(
    py: Python<'py>,
    scene: PyScene<'py>,
    schedule: Vec<usize>,
    cells: usize,
    protected: Option<PyReadonlyArray1<'py, bool>>,
    min_opacity: f64,
    color_bin: f64,
    max_energy: f64,
    min_coverage: f64,
    support: f64,
    flag_threshold: f64,
    flag_members: usize,
    protection: f64,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let scene = scene.borrow()?;
    let protected = protected
        .as_ref()
        .map(|p| arrays::flat("protected", p))
        .transpose()?;
    let policy = Paper {
        min_opacity,
        color_bin,
        max_energy,
        min_coverage,
        support,
        texture: Texture {
            threshold: flag_threshold,
            members: flag_members,
        },
        protection,
    };
    let kernels = kernels();
    let outcome = long(py, progress, |control| {
        let backend = backend(&kernels);
        policy.run(&scene, protected, cells, &schedule, backend, control)
    })?;
    let rounds = outcome
        .rounds
        .iter()
        .map(|r| round_dict(py, r))
        .collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
}

/// The default: pairs of neighbours, cheapest first.
#[pyfunction]
#[pyo3(signature = (
    scene, schedule, *, protected, weight, pixel_size, min_opacity, ladder, ladder_steps, neighbors, geometric, dilation,
    pixel_scale, growth, progress=None
))]
fn simplify_pairwise<'py>(
    py: Python<'py>,
    scene: PyScene<'py>,
    schedule: Vec<usize>,
    protected: Option<PyReadonlyArray1<'py, bool>>,
    weight: Option<PyReadonlyArray1<'py, f32>>,
    pixel_size: Option<PyReadonlyArray1<'py, f32>>,
    min_opacity: f64,
    ladder: f64,
    ladder_steps: usize,
    neighbors: usize,
    geometric: f64,
    dilation: f64,
    pixel_scale: f64,
    growth: f64,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let scene = scene.borrow()?;
    let protected = protected
        .as_ref()
        .map(|p| arrays::flat("protected", p))
        .transpose()?;
    let weight = weight
        .as_ref()
        .map(|a| arrays::flat("weight", a))
        .transpose()?;
    let pixel = pixel_size
        .as_ref()
        .map(|a| arrays::flat("pixel_size", a))
        .transpose()?;
    let seen = weight
        .zip(pixel)
        .map(|(weight, pixel)| Seen { weight, pixel });
    let policy = Pairwise {
        min_opacity,
        ladder,
        ladder_steps,
        neighbors,
        geometric,
        dilation,
        pixel_scale,
        growth,
    };
    let outcome = long(py, progress, |control| {
        policy.run(&scene, seen, protected, &schedule, control)
    })?;
    let rounds = outcome
        .rounds
        .iter()
        .map(|r| pairwise_dict(py, r))
        .collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
}

/// The rows of a scene in the order that only its content decides.
#[pyfunction]
fn simplify_order<'py>(
    py: Python<'py>,
    scene: PyScene<'py>,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let scene = scene.borrow()?;
    let ordered = long(py, None, |_| Ordered::new(&scene))?;
    Ok(PyArray1::from_vec(py, ordered.rows))
}

/// What views see of a scene, view by view.
#[pyclass(name = "Look")]
struct PyLook(Look);

#[pymethods]
impl PyLook {
    #[new]
    fn new(py: Python<'_>, scene: PyScene<'_>) -> PyResult<Self> {
        let scene = scene.borrow()?;
        Ok(Self(long(py, None, |_| Look::new(&scene))?))
    }

    /// The scene's median point.
    #[getter]
    fn origin(&self) -> [f64; 3] {
        self.0.origin()
    }

    /// Adds views; returns how many rows have been seen so far.
    #[pyo3(signature = (views, choices, progress = None))]
    fn add(
        &mut self,
        py: Python<'_>,
        views: Vec<View>,
        choices: Choices,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<usize> {
        let settings = choices.settings()?;
        let look = &mut self.0;
        long(py, progress, |control| {
            control.begin(views.len() as u64);
            for view in &views {
                control.check()?;
                look.add(&view.camera(), &settings)?;
                control.advance(1);
            }
            Ok(look.seen())
        })
    }

    /// (N,) Σ αT and (N,) the smallest size of a pixel, ∞ where no view looks.
    fn by_row<'py>(
        &self,
        py: Python<'py>,
    ) -> (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>) {
        let (weight, pixel) = self.0.by_row();
        (
            PyArray1::from_vec(py, weight),
            PyArray1::from_vec(py, pixel),
        )
    }
}

fn pairwise_dict<'py>(py: Python<'py>, r: &PairwiseRound) -> PyResult<Bound<'py, PyDict>> {
    let round = PyDict::new(py);
    for (key, value) in [
        ("before", r.before),
        ("dropped", r.dropped),
        ("merged", r.merged),
        ("trimmed", 0),
        ("after", r.after),
    ] {
        round.set_item(key, value)?;
    }
    Ok(round)
}

fn round_dict<'py>(py: Python<'py>, r: &PaperRound) -> PyResult<Bound<'py, PyDict>> {
    let refused = PyDict::new(py);
    refused.set_item("energy", r.refused_energy)?;
    refused.set_item("coverage", r.refused_coverage)?;
    let round = PyDict::new(py);
    round.set_item("refused", refused)?;
    for (key, value) in [
        ("before", r.before),
        ("dropped", r.dropped),
        ("cells", r.cells),
        ("skipped_alone", r.alone),
        ("merged", r.merged_members - r.merged_groups),
        ("undone_groups", r.undone_groups),
        ("clamped_opacities", r.clamped_opacities),
        ("trimmed", r.trimmed),
        ("after", r.after),
    ] {
        round.set_item(key, value)?;
    }
    Ok(round)
}

fn outcome_dict<'py, R>(
    py: Python<'py>,
    outcome: Outcome<R>,
    rounds: Vec<Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let s = outcome.splats;
    let (n, coeffs) = (s.means.len(), s.sh_coeffs);
    let out = PyDict::new(py);
    out.set_item("means", arrays::matrix(py, s.means)?)?;
    out.set_item("quats", arrays::matrix(py, s.quats)?)?;
    out.set_item("scales", arrays::matrix(py, s.scales)?)?;
    out.set_item("logit_opacities", PyArray1::from_vec(py, s.logit_opacities))?;
    let sh = PyArray1::from_vec(py, s.sh.into_flattened()).reshape([n, coeffs, 3])?;
    out.set_item("sh", sh)?;
    out.set_item("parents", PyArray1::from_vec(py, outcome.parents))?;
    out.set_item("protected", PyArray1::from_vec(py, outcome.flags))?;
    out.set_item("clamped_opacities", outcome.clamped_opacities)?;
    out.set_item("infinite_logits", outcome.infinite_logits)?;
    out.set_item("rounds", rounds)?;
    Ok(out)
}

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyLook>()?;
    m.add_function(wrap_pyfunction!(simplify_flags, m)?)?;
    m.add_function(wrap_pyfunction!(simplify_paper, m)?)?;
    m.add_function(wrap_pyfunction!(simplify_order, m)?)?;
    m.add_function(wrap_pyfunction!(simplify_pairwise, m)?)
}
