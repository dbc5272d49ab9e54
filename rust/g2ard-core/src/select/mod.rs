//! View selection: surface cells, their visibility in each view, and greedy choices.

mod coverage;
mod depth;
mod kernels;
mod occluders;
mod pinhole;
mod surface;
mod visible;

pub use coverage::{Chosen, Coverage, Problem};
pub use depth::median_depths;
pub use kernels::ViewKernels;
pub use occluders::{Occluder, Occluders};
pub use pinhole::Pinhole;
pub use surface::{Gaussians, Surface};
pub use visible::{statistics_of, view_statistics, visible_cells};
