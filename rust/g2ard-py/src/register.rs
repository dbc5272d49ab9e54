//! `_core.shot`, `_core.normal_equations`, `_core.flow`, `_core.local_zncc`: images for registration.

use g2ard_core::register::{self, Lens, Light, Photo, Render, Size};
use numpy::{
    PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays::flat;
use crate::work;

type Grey<'py> = PyReadonlyArray2<'py, f64>;
type Mask<'py> = PyReadonlyArray2<'py, bool>;

fn size(image: &Grey<'_>) -> Size {
    Size {
        height: image.shape()[0],
        width: image.shape()[1],
    }
}

fn lens([fx, fy, cx, cy]: [f64; 4]) -> Lens {
    Lens { fx, fy, cx, cy }
}

type Planes<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<bool>>,
);

/// Return (grey, depth, mask) of a render; see `g2ard_core::register::shot`.
#[pyfunction]
pub fn shot<'py>(
    py: Python<'py>,
    image: PyReadonlyArray3<'py, f32>,
    alpha: PyReadonlyArray2<'py, f32>,
    depth: PyReadonlyArray2<'py, f32>,
    min_alpha: f64,
    max_edge: f64,
) -> PyResult<Planes<'py>> {
    let size = Size {
        height: alpha.shape()[0],
        width: alpha.shape()[1],
    };
    let (rgb, alpha) = (flat("image", &image)?, flat("alpha", &alpha)?);
    let depth = flat("depth", &depth)?;
    let found = work::quick(py, || {
        register::shot(rgb, alpha, depth, size, min_alpha, max_edge)
    })?;
    let shape = [size.height, size.width];
    Ok((
        PyArray1::from_vec(py, found.grey).reshape(shape)?,
        PyArray1::from_vec(py, found.depth).reshape(shape)?,
        PyArray1::from_vec(py, found.mask).reshape(shape)?,
    ))
}

type Normal = ([[f64; 9]; 9], [f64; 9], f64, f64, f64);

/// Return (matrix, right, scale, cost, weights) of one step. `photo` is (grey, right, down, mask), `shot` the result of
/// `shot`, `lens` (fx, fy, cx, cy) and `light` (gain, bias).
#[pyfunction]
#[pyo3(signature = (photo, shot, lens, light, scale = None))]
pub fn normal_equations<'py>(
    py: Python<'py>,
    photo: (Grey<'py>, Grey<'py>, Grey<'py>, Mask<'py>),
    shot: (Grey<'py>, Grey<'py>, Mask<'py>),
    lens: [f64; 4],
    light: (f64, f64),
    scale: Option<f64>,
) -> PyResult<Normal> {
    let size = size(&photo.0);
    let photo = Photo {
        grey: flat("photo", &photo.0)?,
        right: flat("photo's gradient", &photo.1)?,
        down: flat("photo's gradient", &photo.2)?,
        mask: flat("photo's mask", &photo.3)?,
    };
    let shot = render(&shot)?;
    let light = Light {
        gain: light.0,
        bias: light.1,
    };
    let lens = self::lens(lens);
    let n = work::quick(py, || {
        register::normal_equations(&photo, &shot, size, &lens, light, scale)
    })?;
    Ok((n.matrix, n.right, n.scale, n.cost, n.weights))
}

fn render<'a>(shot: &'a (Grey<'_>, Grey<'_>, Mask<'_>)) -> PyResult<Render<'a>> {
    Ok(Render {
        grey: flat("shot", &shot.0)?,
        depth: flat("shot's depth", &shot.1)?,
        mask: flat("shot's mask", &shot.2)?,
    })
}

/// Return the root mean square, in pixels, by which ξ and a zoom move the unmasked pixels.
#[pyfunction]
pub fn flow<'py>(
    py: Python<'py>,
    shot: (Grey<'py>, Grey<'py>, Mask<'py>),
    lens: [f64; 4],
    xi: [f64; 7],
) -> PyResult<f64> {
    let size = size(&shot.0);
    let shot = render(&shot)?;
    let lens = self::lens(lens);
    work::quick(py, || register::flow(&shot, size, &lens, &xi))
}

/// Return the median ZNCC over windows; see `g2ard_core::register::local_zncc`.
#[pyfunction]
pub fn local_zncc(
    py: Python<'_>,
    a: Grey<'_>,
    b: Grey<'_>,
    mask: Mask<'_>,
    side: usize,
) -> PyResult<f64> {
    let size = size(&a);
    let (a, b) = (flat("a", &a)?, flat("b", &b)?);
    let mask = flat("mask", &mask)?;
    work::quick(py, || register::local_zncc(a, b, mask, size, side))
}
