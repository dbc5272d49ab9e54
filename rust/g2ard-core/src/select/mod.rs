//! View selection: surface cells, their visibility in each view, and greedy choices.

mod coverage;
mod depth;
mod lazy;
mod light;
mod occluders;
mod pinhole;
mod surface;
mod visible;

pub use coverage::{Coverage, Problem};
pub use lazy::Chosen;
pub use light::Light;
pub use occluders::Occluders;
pub use pinhole::{Occluder, Pinhole};
pub use surface::{Gaussians, Surface};
pub use visible::{ViewKernels, statistics_of};
