//! `g2ard.stages.simplify`.

use g2ard_core::Backend;
use g2ard_core::simplify::{
    Outcome, Pairwise, PairwiseRound, Paper, PaperPlan, PaperRound, Visibility, protection_flags,
};
use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};

use crate::arrays;
use crate::constants::Config;
use crate::device::kernels;
use crate::scene::PyScene;
use crate::work::long;

/// Visibility of each row, such as a `g2ard.rendering.visibility.SampledVisibility`.
#[derive(FromPyObject)]
pub struct PyVisibility<'py> {
    weight: PyReadonlyArray1<'py, f32>,
    pixel_size: PyReadonlyArray1<'py, f32>,
}

impl PyVisibility<'_> {
    pub fn borrow(&self) -> PyResult<Visibility<'_>> {
        Ok(Visibility {
            weight: arrays::flat("weight", &self.weight)?,
            pixel_size: arrays::flat("pixel_size", &self.pixel_size)?,
        })
    }
}

/// Return `protected` (N,) bool of the raw prior over about `cells` cells.
#[pyfunction]
#[pyo3(signature = (scene, cells, config, progress=None))]
pub fn simplify_flags<'py>(
    py: Python<'py>,
    scene: &PyScene,
    cells: usize,
    config: Config<Paper>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
    let kernels = kernels();
    let found = long(py, progress, |control| {
        let splats = ordered.splats(&scene);
        let run = kernels.group_kernels();
        let found = protection_flags(&splats, cells, &config.0, &*run, control)?;
        let mut by_row = vec![false; found.len()];
        for (&row, &flag) in ordered.rows.iter().zip(&found) {
            by_row[row as usize] = flag;
        }
        Ok(by_row)
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// Run the paper's rounds, down to each count of `schedule`, over about `cells` cells each.
#[pyfunction]
#[pyo3(signature = (scene, schedule, cells, config, protected=None, progress=None))]
pub fn simplify_paper<'py>(
    py: Python<'py>,
    scene: &PyScene,
    schedule: Vec<usize>,
    cells: usize,
    config: Config<Paper>,
    protected: Option<PyReadonlyArray1<'py, bool>>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
    let (policy, protected) = (config.0, arrays::optional("protected", &protected)?);
    let kernels = kernels();
    let outcome = long(py, progress, |control| {
        let run = kernels.group_kernels();
        let plan = PaperPlan {
            schedule: &schedule,
            cells,
        };
        policy.run(&scene, ordered, protected, plan, &*run, control)
    })?;
    let rounds = outcome.rounds.iter().map(|r| round_dict(py, r));
    let rounds = rounds.collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
}

/// Run the methods `default` and `fast`: runs of Morton order, then pairs of neighbours, cheapest first.
#[pyfunction]
#[pyo3(signature = (scene, schedule, config, protected=None, visibility=None, progress=None))]
pub fn simplify_pairwise<'py>(
    py: Python<'py>,
    scene: &PyScene,
    schedule: Vec<usize>,
    config: Config<Pairwise>,
    protected: Option<PyReadonlyArray1<'py, bool>>,
    visibility: Option<PyVisibility<'py>>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
    let protected = arrays::optional("protected", &protected)?;
    let visibility = visibility.as_ref().map(PyVisibility::borrow).transpose()?;
    let outcome = long(py, progress, |control| {
        (config.0).run(&scene, ordered, visibility, protected, &schedule, control)
    })?;
    let rounds = outcome.rounds.iter().map(|r| pairwise_dict(py, r));
    let rounds = rounds.collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
}

fn pairwise_dict<'py>(py: Python<'py>, r: &PairwiseRound) -> PyResult<Bound<'py, PyDict>> {
    [
        ("before", r.before),
        ("dropped", r.dropped),
        ("merged", r.merged),
        ("trimmed", 0),
        ("after", r.after),
    ]
    .into_py_dict(py)
}

fn round_dict<'py>(py: Python<'py>, r: &PaperRound) -> PyResult<Bound<'py, PyDict>> {
    let refused = [
        ("energy", r.refused_energy),
        ("coverage", r.refused_coverage),
    ];
    let round = [
        ("before", r.before),
        ("dropped", r.dropped),
        ("cells", r.cells),
        ("skipped_alone", r.alone),
        ("merged", r.merged_members - r.merged_groups),
        ("undone_groups", r.undone_groups),
        ("clamped_opacities", r.clamped_opacities),
        ("trimmed", r.trimmed),
        ("after", r.after),
    ]
    .into_py_dict(py)?;
    round.set_item("refused", refused.into_py_dict(py)?)?;
    Ok(round)
}

pub fn outcome_dict<'py, R>(
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
    out.set_item("protected", PyArray1::from_vec(py, outcome.protected))?;
    out.set_item("clamped_opacities", outcome.clamped_opacities)?;
    out.set_item("infinite_logits", outcome.infinite_logits)?;
    out.set_item("rounds", rounds)?;
    Ok(out)
}
