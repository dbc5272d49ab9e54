//! The processor, as the place where kernels run.

/// The kernels of this crate; each stage implements its own trait for it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;
