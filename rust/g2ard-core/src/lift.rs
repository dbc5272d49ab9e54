//! Coloured points → surface-aligned discs (supplement, "Dense Prior Construction").
