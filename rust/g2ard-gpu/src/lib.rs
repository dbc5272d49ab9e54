//! Compute shaders equivalent to g2ard-core's kernels, for any GPU with Vulkan, Metal or DirectX 12.
//!
//! [`Device`] is a [`g2ard_core::Backend`] and gives the CPU's results within rounding. Each kernel, called a twin, has
//! a folder with its WGSL beside Rust; only `runtime` calls wgpu.

mod device;
mod groups;
mod probe;
mod rows;
pub mod runtime;
mod scan;
mod sort;
#[cfg(test)]
mod testing;
mod train;
mod two;
mod visibility;
mod voxels;

pub use device::{Choice, Device, Drawn};
