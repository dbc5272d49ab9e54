//! `g2ard._core`: registration only; one file per stage.

use pyo3::prelude::*;

mod arrays;
mod constants;
mod device;
mod error;
mod lift;
mod quantize;
mod raster;
mod register;
mod scene;
mod select;
mod simplify;
mod spatial;
mod ssim;
mod tile;
mod train;
mod views;
mod visibility;
mod work;

#[pymodule]
fn _core(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    work::register(m)?;
    constants::register(m)?;
    device::register(m)?;
    scene::register(m)?;
    visibility::register(m)?;
    lift::register(m)?;
    simplify::register(m)?;
    spatial::register(m)?;
    quantize::register(m)?;
    raster::register(m)?;
    register::register(m)?;
    select::register(m)?;
    ssim::register(m)?;
    tile::register(m)?;
    train::register(m)?;
    Ok(())
}
