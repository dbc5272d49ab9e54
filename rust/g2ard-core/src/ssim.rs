//! Fused L1 + SSIM, forward and backward.
