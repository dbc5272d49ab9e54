//! Spatial structures: robust frame, Morton order, adaptive voxel cells, nearest neighbours, rays through cells.

mod frame;
mod knn;
mod morton;
mod rays;
mod voxels;

pub use frame::Frame;
pub use knn::{Neighbor, Tree};
pub use morton::{BITS, codes, order, unit};
pub use rays::Steps;
pub use voxels::{Cells, OCTAVES, first_apart, octave_counts, search_size};
