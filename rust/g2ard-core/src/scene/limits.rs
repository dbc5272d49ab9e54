//! Limits of stored values, in one place. Files hold infinite logits (an opacity byte of 255) and scales whose square
//! exceeds f32.

/// The logit that α = 0 and α = 1, stated exactly, count as in sums: 1e-7 away from them. Readers of files clamp to
/// it too.
pub const LOGIT_OF_OPAQUE: f32 = 16.0;

/// Renderers clip α here, so no Gaussian weighs more, and none is merged into more.
pub const MAX_OPACITY: f64 = 0.99;

/// The logits between which f32 can follow the sigmoid.
pub const DRAWN_LOGITS: (f32, f32) = (-80.0, 80.0);

/// The natural logarithms of the scales between which f32 can follow a projected covariance.
pub const DRAWN_LOG_SCALES: (f32, f32) = (-80.0, 40.0);

/// The same as scales: e⁻⁸⁰ and e⁴⁰.
pub const DRAWN_SCALES: (f32, f32) = (1.8e-35, 2.3e17);

/// A logit as sums take it: finite.
pub fn finite_logit(logit: f32) -> f32 {
    if logit.is_infinite() {
        LOGIT_OF_OPAQUE.copysign(logit)
    } else {
        logit
    }
}
