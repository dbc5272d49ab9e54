//! `g2ard.stages.simplify`.

use g2ard_core::simplify::{
    Outcome, Pairwise, PairwiseRound, Paper, PaperRound, Texture, Visibility, flags,
};
use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays;
use crate::device::{backend, kernels};
use crate::scene::PyScene;
use crate::work::long;

/// `protected` (N,) bool of the raw prior over about `cells` cells.
#[pyfunction]
#[pyo3(signature = (scene, cells, *, threshold, members, progress=None))]
fn simplify_flags<'py>(
    py: Python<'py>,
    scene: &PyScene,
    cells: usize,
    threshold: f64,
    members: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
    let texture = Texture { threshold, members };
    let kernels = kernels();
    let found = long(py, progress, |control| {
        let splats = ordered.splats(&scene);
        let run = backend(&kernels).group_kernels();
        let found = flags(&splats, cells, texture, &*run, control)?;
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
    scene: &PyScene,
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
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
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
        let run = backend(&kernels).group_kernels();
        policy.run(&scene, ordered, protected, cells, &schedule, &*run, control)
    })?;
    let rounds = outcome
        .rounds
        .iter()
        .map(|r| round_dict(py, r))
        .collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
}

/// The methods `default` and `fast`: runs of Morton order, then pairs of neighbours, cheapest first.
#[pyfunction]
#[pyo3(signature = (
    scene, schedule, *, protected, weight, pixel_size, min_opacity, morton_premerge_ratio, morton_premerge_steps, neighbors, geometric_weight,
    dilation, pixel_scale, max_growth, progress=None
))]
fn simplify_pairwise<'py>(
    py: Python<'py>,
    scene: &PyScene,
    schedule: Vec<usize>,
    protected: Option<PyReadonlyArray1<'py, bool>>,
    weight: Option<PyReadonlyArray1<'py, f32>>,
    pixel_size: Option<PyReadonlyArray1<'py, f32>>,
    min_opacity: f64,
    morton_premerge_ratio: f64,
    morton_premerge_steps: usize,
    neighbors: usize,
    geometric_weight: f64,
    dilation: f64,
    pixel_scale: f64,
    max_growth: f64,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (splats, ordered) = (scene.splats(py)?, &scene.ordered);
    let scene = splats.borrow()?;
    let protected = protected
        .as_ref()
        .map(|p| arrays::flat("protected", p))
        .transpose()?;
    let weight = weight
        .as_ref()
        .map(|a| arrays::flat("weight", a))
        .transpose()?;
    let pixel_size = pixel_size
        .as_ref()
        .map(|a| arrays::flat("pixel_size", a))
        .transpose()?;
    let visibility = weight
        .zip(pixel_size)
        .map(|(weight, pixel_size)| Visibility { weight, pixel_size });
    let policy = Pairwise {
        min_opacity,
        morton_premerge_ratio,
        morton_premerge_steps,
        neighbors,
        geometric_weight,
        dilation,
        pixel_scale,
        max_growth,
    };
    let outcome = long(py, progress, |control| {
        policy.run(&scene, ordered, visibility, protected, &schedule, control)
    })?;
    let rounds = outcome
        .rounds
        .iter()
        .map(|r| pairwise_dict(py, r))
        .collect::<PyResult<Vec<_>>>()?;
    outcome_dict(py, outcome, rounds)
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
    out.set_item("protected", PyArray1::from_vec(py, outcome.flags))?;
    out.set_item("clamped_opacities", outcome.clamped_opacities)?;
    out.set_item("infinite_logits", outcome.infinite_logits)?;
    out.set_item("rounds", rounds)?;
    Ok(out)
}

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(simplify_flags, m)?)?;
    m.add_function(wrap_pyfunction!(simplify_paper, m)?)?;
    m.add_function(wrap_pyfunction!(simplify_pairwise, m)?)
}
