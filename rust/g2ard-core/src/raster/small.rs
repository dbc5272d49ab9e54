//! A small scene in one view, for tests of whole passes: several chunks, tiles and batches; few where Miri runs them.

use super::{Camera, Params};
use crate::random::Lcg;

/// Rows of the scene; under Miri the chunks of work are as much smaller.
pub(crate) const ROWS: usize = if cfg!(miri) { 33 } else { 3000 };
const SH_COEFFS: usize = 4;

/// Every attribute of its Gaussians, row-major.
pub(crate) struct Small {
    means: Vec<f32>,
    quats: Vec<f32>,
    log_scales: Vec<f32>,
    logits: Vec<f32>,
    sh0: Vec<f32>,
    sh_n: Vec<f32>,
}

impl Small {
    pub fn new() -> Self {
        let mut random = Lcg(5);
        let mut draw = |count: usize, low: f64, high: f64| -> Vec<f32> {
            (0..count * ROWS)
                .map(|_| random.between(low, high) as f32)
                .collect()
        };
        Self {
            means: draw(3, -1.0, 1.0),
            quats: draw(4, 0.1, 1.0),
            log_scales: draw(3, -4.0, -1.5),
            logits: draw(1, -4.0, 0.0),
            sh0: draw(3, -1.0, 1.0),
            sh_n: draw(3 * (SH_COEFFS - 1), -0.2, 0.2),
        }
    }

    pub fn params(&self) -> Params<'_> {
        Params {
            means: &self.means,
            quats: &self.quats,
            log_scales: &self.log_scales,
            logit_opacities: &self.logits,
            sh0: &self.sh0,
            sh_n: &self.sh_n,
            sh_coeffs: SH_COEFFS,
            bounds: None,
        }
    }
}

/// A view from three units away; no side is a whole number of tiles.
pub(crate) fn camera() -> Camera {
    let (width, height) = if cfg!(miri) { (18, 17) } else { (75, 50) };
    Camera {
        viewmat: [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 3.0],
        ],
        fx: width as f64,
        fy: width as f64,
        cx: width as f64 / 2.0,
        cy: height as f64 / 2.0,
        width,
        height,
        near: 0.01,
    }
}

/// `values` numbers in [0, 1).
pub(crate) fn noise(values: usize, seed: u64) -> Vec<f32> {
    let mut random = Lcg(seed);
    (0..values).map(|_| random.uniform_f32()).collect()
}

/// Run on one thread, check that two and three threads give the same, and return the result. Under Miri only two are
/// used.
pub(crate) fn on_any_threads<T: PartialEq + Send>(run: impl Fn() -> T + Sync) -> T {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads").install(&run)
    };
    if cfg!(miri) {
        return on(2);
    }
    let one = on(1);
    for threads in 2..4 {
        assert!(
            on(threads) == one,
            "{threads} threads give other bits than one"
        );
    }
    one
}
