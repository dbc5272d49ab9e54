//! Spatial structures: Morton order, adaptive voxel cells, nearest neighbours.
