//! `g2ard.stages.select`.

use g2ard_core::raster::Camera;
use g2ard_core::select::{Coverage, Gaussians, Light, Problem, Surface, ViewKernels};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays;
use crate::constants::Config;
use crate::device::kernels;
use crate::error::{invalid, to_py};
use crate::views::View;
use crate::work::long;

/// Centred means, quats, linear scales, opacities.
#[derive(FromPyObject)]
pub struct Scene<'py>(
    PyReadonlyArray2<'py, f64>,
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray1<'py, f32>,
);

impl Scene<'_> {
    fn borrow(&self) -> PyResult<Gaussians<'_>> {
        let scene = Gaussians {
            means: arrays::rows("means", &self.0)?,
            quats: arrays::rows("quats", &self.1)?,
            scales: arrays::rows("scales", &self.2)?,
            opacities: arrays::flat("opacities", &self.3)?,
        };
        scene.validate().map_err(to_py)?;
        Ok(scene)
    }
}

/// Return surface cells: centers, normals, confidence, weights, size.
#[pyfunction]
pub fn select_surface<'py>(
    py: Python<'py>,
    scene: Scene<'py>,
    cells: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let scene = scene.borrow()?;
    let surface = long(py, None, |_| Surface::of(&scene, cells))?;
    let out = PyDict::new(py);
    out.set_item("size", surface.size)?;
    out.set_item("centers", arrays::matrix(py, surface.centers)?)?;
    out.set_item("normals", arrays::matrix(py, surface.normals)?)?;
    out.set_item("confidence", PyArray1::from_vec(py, surface.confidence))?;
    out.set_item("weights", PyArray1::from_vec(py, surface.weights))?;
    Ok(out)
}

/// Return (C, 2): the share of each view's pixels that show the scene, and the median of their depths.
#[pyfunction]
#[pyo3(signature = (scene, views, progress=None))]
pub fn select_view_statistics<'py>(
    py: Python<'py>,
    scene: Scene<'py>,
    views: Vec<View>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let scene = scene.borrow()?;
    let cameras: Vec<Camera> = views.iter().map(View::camera).collect();
    let kernels = kernels();
    let found = long(py, progress, |control| {
        kernels.view_statistics(&scene, &cameras, control)
    })?;
    arrays::matrix(py, found)
}

type Surfaces<'py> = (
    PyReadonlyArray2<'py, f64>,
    PyReadonlyArray2<'py, f64>,
    PyReadonlyArray1<'py, f64>,
    PyReadonlyArray1<'py, f64>,
    f64,
);

fn surface_of(parts: &Surfaces<'_>) -> PyResult<Surface> {
    let surface = Surface {
        centers: arrays::rows("centers", &parts.0)?.to_vec(),
        normals: arrays::rows("normals", &parts.1)?.to_vec(),
        confidence: arrays::flat("confidence", &parts.2)?.to_vec(),
        weights: arrays::flat("weights", &parts.3)?.to_vec(),
        size: parts.4,
    };
    let m = surface.len();
    for (name, rows) in [
        ("normals", surface.normals.len()),
        ("confidence", surface.confidence.len()),
        ("weights", surface.weights.len()),
    ] {
        if rows != m {
            return Err(invalid(name, format!("{m} rows"), rows));
        }
    }
    Ok(surface)
}

type Lists<'py> = (Bound<'py, PyArray1<u64>>, Bound<'py, PyArray1<u32>>);

/// Return (starts (C + 1,), cells): view v sees cells[starts[v]..starts[v + 1]].
#[pyfunction]
#[pyo3(signature = (scene, surface, views, *, tolerance, progress=None))]
pub fn select_visible<'py>(
    py: Python<'py>,
    scene: Scene<'py>,
    surface: Surfaces<'py>,
    views: Vec<View>,
    tolerance: f32,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Lists<'py>> {
    let (scene, surface) = (scene.borrow()?, surface_of(&surface)?);
    let cameras: Vec<Camera> = views.iter().map(View::camera).collect();
    let kernels = kernels();
    let seen = long(py, progress, |control| {
        kernels.visible_cells(&scene, &surface, tolerance, &cameras, control)
    })?;
    let mut starts = vec![0u64];
    for cells in &seen {
        starts.push(starts[starts.len() - 1] + cells.len() as u64);
    }
    Ok((
        PyArray1::from_vec(py, starts),
        PyArray1::from_vec(py, seen.concat()),
    ))
}

type Choice<'py> = (Bound<'py, PyArray1<u32>>, Bound<'py, PyArray1<f64>>, u64);

/// Each view's cells as `select_visible` returns them, and (V, 3) camera centres.
type Views<'py> = (
    PyReadonlyArray1<'py, u64>,
    PyReadonlyArray1<'py, u32>,
    PyReadonlyArray2<'py, f64>,
);

/// Return (views, gains, evaluations) of greedy maximisation.
#[pyfunction]
#[pyo3(signature = (surface, views, k, config, progress=None))]
pub fn select_greedy<'py>(
    py: Python<'py>,
    surface: Surfaces<'py>,
    views: Views<'py>,
    k: usize,
    config: Config<Coverage>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Choice<'py>> {
    let surface = surface_of(&surface)?;
    let starts = arrays::flat("starts", &views.0)?;
    let cells = arrays::flat("cells", &views.1)?;
    let visible = starts
        .windows(2)
        .map(|w| cells.get(w[0] as usize..w[1] as usize).map(<[u32]>::to_vec))
        .collect::<Option<Vec<_>>>();
    let offsets = || invalid("starts", "ascending offsets into cells", "others");
    let problem = Problem {
        surface: &surface,
        visible: &visible.ok_or_else(offsets)?,
        positions: arrays::rows("positions", &views.2)?,
    };
    let chosen = long(py, progress, |control| {
        problem.greedy(k, &config.0, control)
    })?;
    Ok((
        PyArray1::from_vec(py, chosen.views),
        PyArray1::from_vec(py, chosen.gains),
        chosen.evaluations,
    ))
}

type Gains<'py> = (Bound<'py, PyArray1<u32>>, Bound<'py, PyArray1<f64>>);

/// Return (views, gains) of greedy maximisation of Σ log(1 + before + Σ received), from (V, R) and (R,).
#[pyfunction]
#[pyo3(signature = (received, before, k, progress=None))]
pub fn select_light<'py>(
    py: Python<'py>,
    received: PyReadonlyArray2<'py, f32>,
    before: PyReadonlyArray1<'py, f64>,
    k: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Gains<'py>> {
    let light = Light {
        received: received.as_slice()?,
        before: arrays::flat("before", &before)?,
    };
    let chosen = long(py, progress, |control| light.greedy(k, control))?;
    Ok((
        PyArray1::from_vec(py, chosen.views),
        PyArray1::from_vec(py, chosen.gains),
    ))
}
