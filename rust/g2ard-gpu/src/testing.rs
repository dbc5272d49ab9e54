//! Helpers for tests of GPU kernels.

use std::io::Write;
use std::sync::Once;

use g2ard_core::Splats;
use g2ard_core::random::Lcg;
use g2ard_core::scene::{Means, SceneRef};

use crate::runtime::{Error, Gpu, Options};

/// A device without a limit of its own.
pub const WHOLE: u64 = u64::MAX;

/// Any adapter, software included; `None` on a machine without one, where tests skip.
pub fn gpu() -> Option<Gpu> {
    gpu_in_pieces(WHOLE)
}

/// A device that binds `bytes` at most, so that work goes in pieces.
pub fn gpu_in_pieces(bytes: u64) -> Option<Gpu> {
    let max_binding = Some(bytes);
    let options = Options {
        max_binding,
        ..Options::default()
    };
    match Gpu::open(true, options) {
        Err(Error::NoAdapter) => {
            skip();
            None
        }
        opened => Some(opened.unwrap()),
    }
}

/// Report once that tests skip. Panic instead if the environment says that this machine must have an adapter.
fn skip() {
    static TOLD: Once = Once::new();
    let required = std::env::var_os("G2ARD_REQUIRE_GPU").is_some_and(|v| v == "1");
    assert!(!required, "no adapter, but G2ARD_REQUIRE_GPU=1 is set");
    // Not by `eprintln`, whose lines cargo hides for tests that pass.
    TOLD.call_once(|| {
        let _ = writeln!(
            std::io::stderr(),
            "\ng2ard-gpu: skipped the tests that need a GPU, because there is no adapter; \
             to run them, install Mesa's lavapipe (mesa-vulkan-drivers)"
        );
    });
}

/// Run `compare` on a device for each limit of bytes that it binds at most.
pub fn compare_on_gpu(limits: &[u64], compare: impl Fn(&Gpu)) {
    limits
        .iter()
        .filter_map(|&bytes| gpu_in_pieces(bytes))
        .for_each(|gpu| compare(&gpu));
}

/// A scene as callers pass it.
pub fn borrowed(splats: &Splats) -> SceneRef<'_> {
    SceneRef {
        means: Means::F64(&splats.means),
        quats: &splats.quats,
        scales: &splats.scales,
        logit_opacities: &splats.logit_opacities,
        sh0: &splats.sh[..splats.len()],
        sh_rest: &[],
        rest: 0,
    }
}

/// Discs on two wavy sheets with noise, of a few large and many small ones.
fn sheets(count: usize, random: &mut Lcg) -> Splats {
    let mut splats = Splats {
        sh_coeffs: 4,
        ..Splats::default()
    };
    for _ in 0..count {
        let (x, y) = (10.0 * random.uniform() - 5.0, 10.0 * random.uniform() - 5.0);
        let sheet = random.below(2) as f64;
        let z = sheet + 0.3 * (1.7 * x).sin() * (1.1 * y).cos() + 0.01 * random.uniform();
        splats.means.push([x, y, z].map(|v| f64::from(v as f32)));
        splats
            .quats
            .push([0; 4].map(|_| (random.uniform() - 0.5) as f32));
        let size = 0.02 * (3.0 * random.uniform()).exp();
        splats
            .scales
            .push([1.0, 0.3 + 0.7 * random.uniform(), 0.02].map(|s| (s * size) as f32));
        splats
            .logit_opacities
            .push((8.0 * random.uniform() - 3.0) as f32);
        for k in 0..splats.sh_coeffs {
            let smooth = if k == 0 { x.sin() + sheet } else { 0.0 };
            splats
                .sh
                .push([0; 3].map(|_| (smooth + 0.3 * (random.uniform() - 0.5)) as f32));
        }
    }
    splats
}

/// Difficult scenes on which each kernel is compared with the CPU's.
pub fn scenes(count: usize) -> Vec<(&'static str, Splats)> {
    let mut random = Lcg(11);
    let plain = sheets(count, &mut random);
    let with = |change: &dyn Fn(usize, &mut Splats)| {
        let mut splats = plain.clone();
        (0..splats.len()).for_each(|i| change(i, &mut splats));
        splats
    };
    let utm = with(&|i, s| {
        let m = s.means[i];
        s.means[i] = [m[0] + 691_234.567, m[1] + 5_334_567.891, m[2] + 512.3];
    });
    let collinear = with(&|i, s| {
        let t = s.means[i][0];
        s.means[i] = [t, 2.0 * t, -0.5 * t];
    });
    let identical = with(&|i, s| {
        s.means[i] = [1.0, 2.0, 3.0];
        s.quats[i] = s.quats[0];
        s.scales[i] = s.scales[0];
    });
    let flat = with(&|i, s| s.means[i][2] = 0.0);
    // Fits that depend on a single row.
    let spikes = with(&|i, s| {
        s.means[i][2] = if i % 9 == 0 {
            0.02 + 1e-3 * i as f64
        } else {
            0.0
        }
    });
    let wild = with(&|i, s| {
        let power = 2f32.powi((i % 61) as i32 - 40);
        s.scales[i] = s.scales[i].map(|v| v * power);
        s.logit_opacities[i] *= 6.0;
        if i % 500 == 1 {
            s.means[i] = s.means[i].map(|v| v * 2e4);
        }
        if i % 97 == 0 {
            s.quats[i] = [0.0; 4];
            s.scales[i][2] = 0.0;
        }
        if i % 5 == 0 && i > 0 {
            s.means[i] = s.means[i - 1];
        }
    });
    // Rows without any mass to weigh by.
    let massless = with(&|i, s| s.scales[i] = [s.scales[i][0], 0.0, 0.0]);
    let small = |n: usize| {
        let mut random = Lcg(7);
        sheets(n, &mut random)
    };
    vec![
        ("sheets", plain),
        ("at UTM offsets", utm),
        ("collinear", collinear),
        ("identical", identical),
        ("flat", flat),
        ("flat with spikes", spikes),
        ("wild scales, floaters, duplicates", wild),
        ("of no area", massless),
        ("one row", small(1)),
        ("two rows", small(2)),
        ("nine rows", small(9)),
    ]
}
