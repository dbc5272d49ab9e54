//! Geometry kernels of g2ard, in pure Rust.
//!
//! Data flows one way: points → [`lift`] → [`splats`] → [`simplify`] → [`raster`] and [`ssim`]; [`quantize`] serves file formats.
//! Results never depend on the number of threads: every reduction has a fixed order.

pub mod backend;
pub mod control;
pub mod error;
pub mod lift;
pub mod linalg;
pub mod quantize;
pub mod raster;
pub mod select;
pub mod simplify;
pub mod spatial;
pub mod splats;
pub mod ssim;
pub mod train;

pub use backend::{Backend, Cpu};
pub use control::Control;
pub use error::{Error, Result};
pub use splats::Splats;
