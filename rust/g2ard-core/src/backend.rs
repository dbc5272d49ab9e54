//! Where the heavy kernels of simplification and selection run: on the CPU, or on a device that computes the same.
//!
//! Stages know only the traits of their own kernels; this module alone knows both.

use crate::Cpu;
use crate::select::ViewKernels;
use crate::simplify::GroupKernels;

/// All kernels that have more than one implementation. One may be faster than [`Cpu`]'s; it may not differ from it.
pub trait Backend: ViewKernels {
    /// The kernels for one run of simplification, which may keep the run's rows between calls.
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_>;
}

impl Backend for Cpu {
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_> {
        Box::new(*self)
    }
}
