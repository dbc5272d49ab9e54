use super::*;
use crate::raster::small::{ROWS, Small, camera, noise, on_any_threads};
use crate::raster::{Accumulated, Gradients};

fn bits(planes: &[&[f32]]) -> Vec<u32> {
    planes.concat().iter().map(|v| v.to_bits()).collect()
}

/// A view with depth and median, and its gradients from every plane.
fn passes() -> (Vec<u32>, Vec<u32>) {
    let (scene, camera) = (Small::new(), camera());
    let (params, pixels) = (scene.params(), camera.width * camera.height);
    let [mut rgb, mut alpha, mut depth, mut median] = [3, 1, 1, 1].map(|n| vec![0.0; n * pixels]);
    let mut rasterizer = Rasterizer::default();
    let mut image = Image {
        rgb: &mut rgb,
        alpha: &mut alpha,
        depth: Some(&mut depth),
        median: Some(&mut median),
    };
    let (settings, background) = (super::super::Settings::default(), [0.1, 0.2, 0.3]);
    rasterizer
        .forward(&params, &camera, &settings, background, &mut image)
        .unwrap();
    let [pull_rgb, pull_alpha, pull_depth] = [3, 1, 1].map(|n| noise(n * pixels, n as u64));
    let pull = ImageGradients {
        rgb: &pull_rgb,
        alpha: Some(&pull_alpha),
        depth: Some(&pull_depth),
    };
    let mut found = [3, 4, 3, 1, 3, params.sh_n.len() / ROWS].map(|n| vec![0.0; n * ROWS]);
    let [means, quats, log_scales, logit_opacities, sh0, sh_n] = &mut found;
    let mut gradients = Gradients {
        means,
        quats,
        log_scales,
        logit_opacities,
        sh0,
        sh_n,
    };
    rasterizer.backward(&params, &pull, &mut gradients).unwrap();
    let found: Vec<&[f32]> = found.iter().map(Vec::as_slice).collect();
    (bits(&[&rgb, &alpha, &depth, &median]), bits(&found))
}

#[test]
fn both_passes_give_the_same_bits_on_any_number_of_threads() {
    let (image, gradients) = on_any_threads(passes);
    assert!(image.iter().all(|&v| f32::from_bits(v).is_finite()));
    let moved = gradients.iter().filter(|&&v| f32::from_bits(v) != 0.0);
    assert!(moved.count() > gradients.len() / 3);
}

#[test]
fn sums_of_visibility_give_the_same_bits_on_any_number_of_threads() {
    let weights = on_any_threads(|| {
        let (scene, mut sums) = (Small::new(), Accumulated::new(ROWS));
        let settings = super::super::Settings::default();
        Rasterizer::default()
            .accumulate(&scene.params(), &camera(), &settings, &mut sums)
            .unwrap();
        sums.weight
    });
    assert!(weights.iter().filter(|&&w| w > 0.0).count() > ROWS / 3);
}
