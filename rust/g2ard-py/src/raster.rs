//! `_core.Rasterizer`: buffers of one view, forward and backward passes, and sums for visibility.

use g2ard_core::Result;
use g2ard_core::raster::simd::Isa;
use g2ard_core::raster::{
    Accumulated, Bounds, Camera, Canvas, Gradients, Image, ImageGradients, Params, Rasterizer,
    Settings, light_on as core_light_on, reaching as core_reaching,
};
use numpy::{
    IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArrayDyn,
    PyReadwriteArrayDyn, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

use crate::arrays::{self, flat, optional, writable};
use crate::device::{self, Drawn};
use crate::error::{invalid, to_py};
use crate::views::{Corners, RasterOptions, View};
use crate::work;

pub type Floats<'py> = PyReadonlyArrayDyn<'py, f32>;

/// The six parameter arrays, in the order that every method takes them.
#[derive(FromPyObject)]
pub struct Arrays<'py>(
    Floats<'py>,
    Floats<'py>,
    Floats<'py>,
    Floats<'py>,
    Floats<'py>,
    Floats<'py>,
);

impl Arrays<'_> {
    pub fn params(&self) -> PyResult<Params<'_>> {
        let shape = self.5.shape();
        let rest = if shape.len() == 3 { shape[1] } else { 0 };
        let params = Params {
            means: flat("means", &self.0)?,
            quats: flat("quats", &self.1)?,
            log_scales: flat("log_scales", &self.2)?,
            logit_opacities: flat("logit_opacities", &self.3)?,
            sh0: flat("sh0", &self.4)?,
            sh_n: flat("shN", &self.5)?,
            sh_coeffs: rest + 1,
            bounds: None,
        };
        params.validate().map_err(to_py)?;
        Ok(params)
    }
}

/// Bounds of a scene's rows, which must not change, so that views skip those that they cannot see.
#[pyclass(name = "RowBounds", module = "g2ard._core", frozen)]
pub struct PyRowBounds(Vec<Bounds>);

#[pymethods]
impl PyRowBounds {
    #[new]
    fn new(py: Python<'_>, arrays: Arrays<'_>) -> PyResult<Self> {
        let params = arrays.params()?;
        work::quick(py, || Ok(Self(params.find_bounds())))
    }
}

impl<'a> Arrays<'a> {
    /// The parameters with their bounds, if they are known.
    fn bounded<'b>(&'b self, bounds: &'b Option<PyRef<'_, PyRowBounds>>) -> PyResult<Params<'b>> {
        Ok(Params {
            bounds: bounds.as_ref().map(|bounds| &bounds.0[..]),
            ..self.params()?
        })
    }
}

pub fn isa_named(name: Option<&str>) -> PyResult<Isa> {
    let Some(name) = name else {
        return Ok(Isa::detect());
    };
    let mut known = Isa::available().into_iter();
    known
        .find(|isa| isa.name() == name)
        .ok_or_else(|| invalid("isa", "one this machine has", name))
}

/// Return the names of the instruction sets that this machine can run, fastest first.
#[pyfunction]
pub fn instruction_sets() -> Vec<&'static str> {
    Isa::available().into_iter().map(Isa::name).collect()
}

/// The planes of a canvas: color (H, W, 3) and light (H, W).
#[derive(FromPyObject)]
pub struct Planes<'py>(PyReadwriteArrayDyn<'py, f32>, PyReadwriteArrayDyn<'py, f32>);

impl Planes<'_> {
    fn canvas(&mut self) -> PyResult<Canvas<'_>> {
        Ok(Canvas {
            rgb: writable("color", &mut self.0)?,
            light: writable("light", &mut self.1)?,
        })
    }
}

/// Buffers of one view; calls from several threads take turns.
#[pyclass(name = "Rasterizer", module = "g2ard._core", frozen)]
pub struct PyRasterizer(Mutex<Rendering>);

struct Rendering {
    inner: Rasterizer,
    /// The scene that `image` drew last, and what a device keeps of it.
    scene: Option<(Py<PyAny>, Drawn)>,
}

impl Rendering {
    /// Draw an image on the CPU.
    fn here(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
    ) -> Result<Vec<f32>> {
        let pixels = camera.width * camera.height;
        let (mut rgb, mut alpha) = (vec![0f32; 3 * pixels], vec![0f32; pixels]);
        let mut image = Image {
            rgb: &mut rgb,
            alpha: &mut alpha,
            depth: None,
            median: None,
        };
        (self.inner).forward(params, camera, settings, background, &mut image)?;
        Ok(rgb)
    }
}

type Array<'py, D> = Bound<'py, numpy::PyArray<f32, D>>;

fn plane<'py>(
    py: Python<'py>,
    values: Option<Vec<f32>>,
    shape: [usize; 2],
) -> PyResult<Option<Array<'py, numpy::Ix2>>> {
    values
        .map(|v| PyArray1::from_vec(py, v).reshape(shape))
        .transpose()
}

#[pymethods]
impl PyRasterizer {
    #[new]
    #[pyo3(signature = (isa = None))]
    fn new(isa: Option<&str>) -> PyResult<Self> {
        Ok(Self(Mutex::new(Rendering {
            inner: Rasterizer::new(isa_named(isa)?),
            scene: None,
        })))
    }

    /// Return the image (H, W, 3) alone, drawn by the device in use. A device keeps the scene while the same tuple of
    /// arrays is passed, whose values must not change. A backward pass needs `forward`.
    #[pyo3(signature = (scene, view, options, background, bounds = None))]
    fn image<'py>(
        &self,
        py: Python<'py>,
        scene: &Bound<'py, PyAny>,
        view: View,
        options: RasterOptions,
        background: [f32; 3],
        bounds: Option<PyRef<'py, PyRowBounds>>,
    ) -> PyResult<Array<'py, numpy::Ix3>> {
        let arrays: Arrays<'_> = scene.extract()?;
        let params = arrays.bounded(&bounds)?;
        let (camera, settings) = (view.camera(), options.settings()?);
        camera.validate().map_err(to_py)?;
        let mut rendering = work::locked(py, &self.0);
        let rendering = &mut *rendering;
        let last = rendering.scene.take();
        let mut drawn = match last {
            Some((same, drawn)) if same.is(scene) => drawn,
            _ => Drawn::default(),
        };
        let rgb = work::quick(py, || {
            match device::image(&mut drawn, &params, &camera, &settings, background)? {
                Some(rgb) => Ok(rgb),
                None => rendering.here(&params, &camera, &settings, background),
            }
        })?;
        rendering.scene = Some((scene.clone().unbind(), drawn));
        PyArray1::from_vec(py, rgb).reshape([camera.height, camera.width, 3])
    }

    /// Return image (H, W, 3), alpha (H, W), depth (H, W) and median depth (H, W); the first `depths` of the two
    /// depths, None for the others.
    #[pyo3(signature = (arrays, view, options, background, depths = 1, bounds = None))]
    #[allow(clippy::type_complexity, clippy::too_many_arguments)]
    fn forward<'py>(
        &self,
        py: Python<'py>,
        arrays: Arrays<'py>,
        view: View,
        options: RasterOptions,
        background: [f32; 3],
        depths: usize,
        bounds: Option<PyRef<'py, PyRowBounds>>,
    ) -> PyResult<(
        Array<'py, numpy::Ix3>,
        Array<'py, numpy::Ix2>,
        Option<Array<'py, numpy::Ix2>>,
        Option<Array<'py, numpy::Ix2>>,
    )> {
        let params = arrays.bounded(&bounds)?;
        let (camera, settings) = (view.camera(), options.settings()?);
        camera.validate().map_err(to_py)?;
        let (height, width) = (camera.height, camera.width);
        let mut rendering = work::locked(py, &self.0);
        let inner = &mut rendering.inner;
        let (rgb, alpha, depth, median) = work::quick(py, || {
            let zeros = || vec![0f32; height * width];
            let (mut rgb, mut alpha) = (vec![0f32; 3 * height * width], zeros());
            let (mut depth, mut median) = ((depths > 0).then(zeros), (depths > 1).then(zeros));
            let mut image = Image {
                rgb: &mut rgb,
                alpha: &mut alpha,
                depth: depth.as_deref_mut(),
                median: median.as_deref_mut(),
            };
            inner.forward(&params, &camera, &settings, background, &mut image)?;
            Ok((rgb, alpha, depth, median))
        })?;
        let shape = [height, width];
        Ok((
            PyArray1::from_vec(py, rgb).reshape([height, width, 3])?,
            PyArray1::from_vec(py, alpha).reshape([height, width])?,
            plane(py, depth, shape)?,
            plane(py, median, shape)?,
        ))
    }

    /// Draw a box of the scene behind what the planes (color, light) show, in place.
    #[pyo3(signature = (arrays, view, options, corners, planes, bounds = None))]
    #[expect(clippy::too_many_arguments, reason = "Python's signature")]
    fn draw(
        &self,
        py: Python<'_>,
        arrays: Arrays<'_>,
        view: View,
        options: RasterOptions,
        corners: Corners,
        mut planes: Planes<'_>,
        bounds: Option<PyRef<'_, PyRowBounds>>,
    ) -> PyResult<()> {
        let params = arrays.bounded(&bounds)?;
        let (camera, settings, region) = (view.camera(), options.settings()?, corners.into());
        let mut canvas = planes.canvas()?;
        let mut rendering = work::locked(py, &self.0);
        let inner = &mut rendering.inner;
        work::quick(py, || {
            inner.draw(&params, &camera, &settings, &region, &mut canvas)
        })?;
        Ok(())
    }

    /// Return gradients of the six arrays, each in its array's shape.
    #[pyo3(signature = (arrays, image, alpha = None, depth = None))]
    fn backward<'py>(
        &self,
        py: Python<'py>,
        arrays: Arrays<'py>,
        image: Floats<'py>,
        alpha: Option<Floats<'py>>,
        depth: Option<Floats<'py>>,
    ) -> PyResult<Vec<Bound<'py, numpy::PyArrayDyn<f32>>>> {
        let params = arrays.params()?;
        let gradients = ImageGradients {
            rgb: flat("image gradient", &image)?,
            alpha: optional("alpha gradient", &alpha)?,
            depth: optional("depth gradient", &depth)?,
        };
        let mut rendering = work::locked(py, &self.0);
        let rendering = &mut *rendering;
        let out = work::quick(py, || {
            let mut out = [
                params.means,
                params.quats,
                params.log_scales,
                params.logit_opacities,
                params.sh0,
                params.sh_n,
            ]
            .map(|values| vec![0f32; values.len()]);
            let [means, quats, log_scales, logit_opacities, sh0, sh_n] = &mut out;
            let mut rows = Gradients {
                means,
                quats,
                log_scales,
                logit_opacities,
                sh0,
                sh_n,
            };
            (rendering.inner).backward(&params, &gradients, &mut rows)?;
            Ok(out)
        })?;
        let shapes = [
            &arrays.0, &arrays.1, &arrays.2, &arrays.3, &arrays.4, &arrays.5,
        ];
        out.into_iter()
            .zip(shapes)
            .map(|(values, like)| PyArray1::from_vec(py, values).reshape(like.shape().to_vec()))
            .collect()
    }
}

/// Return the most light left in pixels that are still going and whose rays meet a box.
#[pyfunction]
pub fn light_on(
    py: Python<'_>,
    light: PyReadonlyArray2<'_, f32>,
    view: View,
    options: RasterOptions,
    corners: Corners,
) -> PyResult<f32> {
    let (camera, settings, region) = (view.camera(), options.settings()?, corners.into());
    let light = flat("light", &light)?;
    work::quick(py, || core_light_on(&region, &camera, light, &settings))
}

/// Return (N,) whether a Gaussian may have pairs in a box in some view, from means, largest scales and opacities.
#[pyfunction]
pub fn reaching<'py>(
    py: Python<'py>,
    means: PyReadonlyArray2<'_, f32>,
    scales: PyReadonlyArray1<'_, f32>,
    opacities: PyReadonlyArray1<'_, f32>,
    views: Vec<View>,
    corners: Corners,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let (means, scales) = (arrays::rows("means", &means)?, flat("scales", &scales)?);
    let opacities = flat("opacities", &opacities)?;
    let (cameras, region) = (views.iter().map(View::camera), corners.into());
    let cameras: Vec<_> = cameras.collect();
    let rows = work::long(py, None, |_| {
        core_reaching(&region, &cameras, means, scales, opacities)
    })?;
    Ok(rows.into_pyarray(py))
}

/// Return sums per Gaussian over all `views`: a dict of (N,) arrays.
#[pyfunction]
#[pyo3(signature = (arrays, views, options, progress = None))]
pub fn accumulate<'py>(
    py: Python<'py>,
    arrays: Arrays<'py>,
    views: Vec<View>,
    options: RasterOptions,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = arrays.params()?;
    let settings = options.settings()?;
    let sums = work::long(py, progress, |control| {
        let mut rasterizer = Rasterizer::default();
        let mut sums = Accumulated::new(params.len());
        control.begin(views.len() as u64);
        for view in &views {
            control.check()?;
            rasterizer.accumulate(&params, &view.camera(), &settings, &mut sums)?;
            control.advance(1);
        }
        Ok(sums)
    })?;
    dict_of(py, sums)
}

/// Return the sums of `accumulate` for each view alone; views are drawn in parallel.
#[pyfunction]
#[pyo3(signature = (arrays, views, options, progress = None))]
pub fn accumulate_each<'py>(
    py: Python<'py>,
    arrays: Arrays<'py>,
    views: Vec<View>,
    options: RasterOptions,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let params = arrays.params()?;
    let settings = options.settings()?;
    let all = work::long(py, progress, |control| {
        control.begin(views.len() as u64);
        // Buffers that views share: new ones cost more than a small view.
        let spare = Mutex::new(Vec::<Rasterizer>::new());
        let spare = || spare.lock().unwrap_or_else(PoisonError::into_inner);
        let one = |view: &View| {
            control.check()?;
            let mut rasterizer = spare().pop().unwrap_or_default();
            let mut sums = Accumulated::new(params.len());
            rasterizer.accumulate(&params, &view.camera(), &settings, &mut sums)?;
            spare().push(rasterizer);
            control.advance(1);
            Ok(sums)
        };
        let views = views.par_iter().with_max_len(1).map(one);
        views.collect::<Result<Vec<_>>>()
    })?;
    all.into_iter().map(|sums| dict_of(py, sums)).collect()
}

fn dict_of(py: Python<'_>, sums: Accumulated) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("weight", sums.weight.into_pyarray(py))?;
    dict.set_item("transmittance", sums.transmittance.into_pyarray(py))?;
    dict.set_item("hits", sums.hits.into_pyarray(py))?;
    dict.set_item("dominant", sums.dominant.into_pyarray(py))?;
    dict.set_item("peak", sums.peak.into_pyarray(py))?;
    dict.set_item("pixel_size", sums.pixel_size.into_pyarray(py))?;
    Ok(dict)
}
