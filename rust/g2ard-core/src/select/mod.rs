//! Which views are worth having: surface cells, what each view sees of them, and greedy choices.

mod coverage;
mod depth;
mod opaque;
mod pinhole;
mod surface;
mod visible;

pub use coverage::{Chosen, Coverage, Problem};
pub use depth::median_depths;
pub use opaque::{Opaque, Row};
pub use pinhole::Pinhole;
pub use surface::{Gaussians, Surface};
pub use visible::{look_of, looks, visible};
