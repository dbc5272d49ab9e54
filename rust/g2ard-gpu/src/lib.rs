//! Compute-shader twins of g2ard-core's kernels, for any GPU that speaks Vulkan, Metal or DirectX 12.
//!
//! [`Device`] is a [`g2ard_core::Backend`]: policies call it as they call the CPU, and get the same results within rounding. Each
//! twin has a folder of its own, WGSL beside Rust; only `runtime` calls wgpu.

mod device;
mod groups;
mod probe;
mod rows;
pub mod runtime;
mod scan;
mod sort;
#[cfg(test)]
mod testing;
mod two;
mod visibility;
mod voxels;

pub use device::{Choice, Device};
