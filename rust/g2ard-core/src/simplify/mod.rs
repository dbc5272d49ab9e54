//! Simplification: shared parts (scene order, moments, residual flags, guards, trim) and the policies over them.
//!
//! Every policy works on a scene's own order ([`crate::scene::Ordered`]), so the result depends neither on the order of
//! the input's rows nor on the number of threads.

mod clusters;
mod cost;
mod guards;
mod importance;
mod kernels;
mod leaves;
mod matching;
mod moments;
mod morton_tree;
mod outcome;
mod pairwise;
mod paper;
mod protection;
mod rows;
mod surface;
mod tile;
mod trim;

pub use clusters::Pair;
pub use guards::{coverage, disc};
pub use importance::Importance;
pub use kernels::{Group, GroupKernels, means_of};
pub use leaves::{Frame, Sums, Visibility};
pub use moments::{Merged, merge, optical_mass, pool, weights};
pub use outcome::Outcome;
pub use pairwise::{Pairwise, PairwiseRound};
pub use paper::{Paper, PaperPlan, PaperRound};
pub use protection::{color, protection_flags};
pub use tile::{Tile, TilePlan};

use crate::Splats;

/// A row that went nowhere: dropped or trimmed.
pub const GONE: u32 = u32::MAX;

/// Rows of one round's output and where each row of its input went.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Step {
    pub splats: Splats,
    /// Output row of each input row, or [`GONE`].
    pub parents: Vec<u32>,
    /// Merged rows whose α was clipped, so that some of their mass is lost.
    pub clamped: usize,
}
