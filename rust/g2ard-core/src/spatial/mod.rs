//! Spatial structures: robust frame, Morton order, adaptive voxel cells, nearest neighbours.

mod frame;
mod knn;
mod morton;
mod voxels;

pub use frame::Frame;
pub use knn::{Neighbor, Tree};
pub use morton::{BITS, codes, order, unit};
pub use voxels::{Cells, OCTAVES, first_apart, octave_counts, search_size};
