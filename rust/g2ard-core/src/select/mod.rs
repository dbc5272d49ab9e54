//! Which views are worth having: surface cells, what each view sees of them, and greedy choices.

mod coverage;
mod depth;
mod surface;

pub use coverage::{Chosen, Coverage, Problem};
pub use depth::{Opaque, median_depths, visible};
pub use surface::{Gaussians, Surface};
