//! Spatial structures: robust bounds, Morton order, adaptive voxel cells, nearest neighbours, rays through cells.

mod bounds;
mod knn;
mod morton;
mod rays;
mod voxels;

pub use bounds::RobustBounds;
pub use knn::{Neighbor, Tree};
pub use morton::{BITS, code, codes, codes_in_box, order, unit};
pub use rays::Steps;
pub use voxels::{Cells, OCTAVES, first_apart, octave_counts, search_size};
