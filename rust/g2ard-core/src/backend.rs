//! Choice of the device for the heavy kernels of simplification, selection and training: the CPU, or another device.
//!
//! Stages know only the traits of their own kernels; this module alone knows both.

use crate::Cpu;
use crate::raster::visibility::VisibilityKernels;
use crate::select::ViewKernels;
use crate::simplify::GroupKernels;
use crate::train::TrainKernels;

/// All kernels that have more than one implementation. Those of a device may differ from [`Cpu`]'s within a stated
/// tolerance, and are the same from run to run.
pub trait Backend: ViewKernels + VisibilityKernels + TrainKernels {
    /// The kernels for one run of simplification, which may keep the run's rows between calls.
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_>;
}

impl Backend for Cpu {
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_> {
        Box::new(*self)
    }
}
