//! All access to a device: adapters, buffers, pipelines, work and errors.

mod adapters;
mod error;
mod gpu;
mod owned;
mod panics;
mod room;
mod work;

pub use adapters::{Adapter, list};
pub use error::{Error, Result};
pub(crate) use gpu::lock;
pub use gpu::{Buffer, Constants, Gpu, Kernel, Options};
pub use owned::Owned;
pub use panics::guarded;
pub use work::{Pending, Program, Work};
