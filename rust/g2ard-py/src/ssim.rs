//! `_core.l1_ssim`, `_core.ssim`, `_core.psnr`.

use g2ard_core::ssim::{self, Loss, Shape};
use numpy::{PyArray1, PyArray3, PyArrayMethods, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::arrays::flat;
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

/// Return (loss, dloss/dimage) of (1 − λ)·L1 + λ·(1 − SSIM).
#[pyfunction]
pub fn l1_ssim<'py>(
    py: Python<'py>,
    image: Image<'py>,
    target: Image<'py>,
    ssim_weight: f32,
) -> PyResult<(f64, Bound<'py, PyArray3<f32>>)> {
    let (a, b, shape) = pair(&image, &target)?;
    let (loss, gradient) = work::quick(py, || {
        let mut gradient = vec![0.0; shape.values()];
        let loss = Loss::default().l1_ssim(a, b, shape, ssim_weight, &mut gradient)?;
        Ok((loss, gradient))
    })?;
    let gradient =
        PyArray1::from_vec(py, gradient).reshape([shape.height, shape.width, shape.channels])?;
    Ok((loss, gradient))
}

/// Return the mean SSIM of two (H, W, C) images in 0–1.
#[pyfunction]
#[pyo3(name = "ssim")]
pub fn ssim_metric(py: Python<'_>, image: Image<'_>, target: Image<'_>) -> PyResult<f64> {
    let (a, b, shape) = pair(&image, &target)?;
    work::quick(py, || ssim::ssim(a, b, shape))
}

/// Return the PSNR in dB of two (H, W, C) images in 0–1.
#[pyfunction]
pub fn psnr(py: Python<'_>, image: Image<'_>, target: Image<'_>) -> PyResult<f64> {
    let (a, b, shape) = pair(&image, &target)?;
    work::quick(py, || ssim::psnr(a, b, shape))
}
