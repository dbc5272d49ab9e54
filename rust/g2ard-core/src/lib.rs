//! Geometry kernels of g2ard, in pure Rust.
//!
//! Data flows one way: points → [`lift`] → [`splats`] → [`scene`] → [`raster`] → [`simplify`], [`select`]
//! and [`train`]; [`quantize`] serves file formats, [`register`] photos. [`backend`] alone knows the stages whose kernels a device may run.
//! Results never depend on the number of threads: every reduction has a fixed order.

#[macro_use]
pub mod error; // first, for its macro

pub mod backend;
pub mod constants;
pub mod control;
mod cpu;
pub mod lift;
pub mod linalg;
pub mod quantize;
#[doc(hidden)]
pub mod random;
pub mod raster;
pub mod register;
pub mod scene;
pub mod select;
pub mod simplify;
pub mod spatial;
pub mod splats;
pub mod ssim;
pub mod train;

pub use backend::Backend;
pub use control::Control;
pub use cpu::Cpu;
pub use error::{Error, Result};
pub use splats::Splats;
