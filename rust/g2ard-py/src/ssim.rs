//! `_core.l1_ssim`, `_core.ssim`, `_core.psnr`, `_core.steps`, `_core.contrasts`.

use g2ard_core::ssim::{self, Compared, Loss, Mask, Shape};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays::{flat, optional};
use crate::error::invalid;
use crate::work;

type Image<'py> = PyReadonlyArray3<'py, f32>;

/// Both images' values and their common shape.
fn pair<'a>(
    image: &'a Image<'_>,
    target: &'a Image<'_>,
) -> PyResult<(&'a [f32], &'a [f32], Shape)> {
    let [height, width, channels] = [0, 1, 2].map(|i| image.shape()[i]);
    if image.shape() != target.shape() {
        let expected = format!("the image's shape {:?}", image.shape());
        return Err(invalid("target", expected, format!("{:?}", target.shape())));
    }
    let shape = Shape {
        height,
        width,
        channels,
    };
    Ok((flat("image", image)?, flat("target", target)?, shape))
}

/// Return (loss, dloss/dimage) of (1 − λ)·L1 + λ·(1 − SSIM). `mask`: (H, W), where it counts.
#[pyfunction]
#[pyo3(signature = (image, target, ssim_weight, mask = None))]
pub fn l1_ssim<'py>(
    py: Python<'py>,
    image: Image<'py>,
    target: Image<'py>,
    ssim_weight: f32,
    mask: Option<PyReadonlyArray2<'py, bool>>,
) -> PyResult<(f64, Bound<'py, PyArray3<f32>>)> {
    let (a, b, shape) = pair(&image, &target)?;
    let counts = optional("mask", &mask)?;
    let (loss, gradient) = work::quick(py, || {
        let mut gradient = vec![0.0; shape.values()];
        let mask = counts.map(|counts| Mask::new(counts, shape)).transpose()?;
        let loss =
            Loss::default().l1_ssim(a, b, shape, mask.as_ref(), ssim_weight, &mut gradient)?;
        Ok((loss, gradient))
    })?;
    let gradient =
        PyArray1::from_vec(py, gradient).reshape([shape.height, shape.width, shape.channels])?;
    Ok((loss, gradient))
}

/// Return the mean SSIM of two (H, W, C) images in 0–1. `mask`: (H, W), pixels that count.
#[pyfunction]
#[pyo3(name = "ssim", signature = (image, target, mask = None))]
pub fn ssim_metric(
    py: Python<'_>,
    image: Image<'_>,
    target: Image<'_>,
    mask: Option<PyReadonlyArray2<'_, bool>>,
) -> PyResult<f64> {
    let (a, b, shape) = pair(&image, &target)?;
    let counts = optional("mask", &mask)?;
    work::quick(py, || {
        let mask = counts.map(|counts| Mask::new(counts, shape)).transpose()?;
        ssim::ssim(a, b, shape, mask.as_ref())
    })
}

/// Return the PSNR in dB of two (H, W, C) images in 0–1.
#[pyfunction]
pub fn psnr(py: Python<'_>, image: Image<'_>, target: Image<'_>) -> PyResult<f64> {
    let (a, b, shape) = pair(&image, &target)?;
    work::quick(py, || ssim::psnr(a, b, shape))
}

/// Return sums over the differences g and g′ between neighbouring pixels of an image and its target: count,
/// Σ (g − g′)², Σ g², Σ g′², Σ g·g′. `mask`: (H, W), pixels that count.
#[pyfunction]
#[pyo3(signature = (image, target, mask = None))]
pub fn steps(
    py: Python<'_>,
    image: Image<'_>,
    target: Image<'_>,
    mask: Option<PyReadonlyArray2<'_, bool>>,
) -> PyResult<[f64; 5]> {
    let (a, b, shape) = pair(&image, &target)?;
    let counts = optional("mask", &mask)?;
    let sums = work::quick(py, || Ok(Compared::new(a, b, shape, counts)?.steps()))?;
    Ok([sums.count, sums.error, sums.own, sums.wanted, sums.common])
}

/// Return (R, 2): for each region of 32×32 pixels the mean of the target's squared contrast and that of its product
/// with the image's. `mask`: (H, W), pixels that count.
#[pyfunction]
#[pyo3(signature = (image, target, mask = None))]
pub fn contrasts<'py>(
    py: Python<'py>,
    image: Image<'py>,
    target: Image<'py>,
    mask: Option<PyReadonlyArray2<'py, bool>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (a, b, shape) = pair(&image, &target)?;
    let counts = optional("mask", &mask)?;
    let found = work::quick(py, || Ok(Compared::new(a, b, shape, counts)?.contrasts()))?;
    let regions = found.len();
    PyArray1::from_vec(py, found.into_flattened()).reshape([regions, 2])
}
