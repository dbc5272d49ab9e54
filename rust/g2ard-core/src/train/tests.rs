use super::*;
use crate::raster::small::{Small, camera, noise, on_any_threads};

#[test]
fn steps_give_the_same_bits_on_any_number_of_threads_and_learn() {
    let losses = on_any_threads(|| {
        let (scene, camera) = (Small::new(), camera());
        let target = noise(3 * camera.width * camera.height, 9);
        let mut trainer = Trainer::new(&scene.params(), None, Isa::detect()).unwrap();
        let input = StepInput {
            camera: &camera,
            settings: Settings::default(),
            background: [0.0; 3],
            target: &target,
            mask: None,
            view: None,
            ssim_weight: 0.2,
            relative: None,
            rates: Rates {
                means: 1e-3,
                quats: 1e-3,
                log_scales: 5e-3,
                logit_opacities: 0.02,
                sh0: 0.02,
                sh_n: 1e-3,
                momentum: 0.6,
            },
            reach: None,
            finest: 0.0,
            regularizers: None,
        };
        let steps = if cfg!(miri) { 2 } else { 8 };
        let losses: Vec<u64> = (0..steps)
            .map(|_| trainer.step(&input).unwrap().loss.to_bits())
            .collect();
        let values = trainer.store().export().values;
        (
            losses,
            values.iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
        )
    })
    .0;
    let loss = |at: usize| f64::from_bits(losses[at]);
    assert!(
        loss(losses.len() - 1) < loss(0),
        "{} to {}",
        loss(0),
        loss(losses.len() - 1)
    );
}

/// How far the means go in one step with a `finest` size.
fn moved(finest: f32) -> f32 {
    let (scene, camera) = (Small::new(), camera());
    let target = noise(3 * camera.width * camera.height, 9);
    let mut trainer = Trainer::new(&scene.params(), None, Isa::detect()).unwrap();
    let before = trainer.store().columns(0, 3);
    let input = StepInput {
        camera: &camera,
        settings: Settings::default(),
        background: [0.0; 3],
        target: &target,
        mask: None,
        view: None,
        ssim_weight: 0.2,
        relative: None,
        rates: Rates {
            means: 1e-3,
            ..Rates::default()
        },
        reach: None,
        finest,
        regularizers: None,
    };
    trainer.step(&input).unwrap();
    let after = trainer.store().columns(0, 3);
    before.iter().zip(&after).map(|(a, b)| (a - b).abs()).sum()
}

#[test]
fn what_is_below_the_finest_size_hardly_moves() {
    let free = moved(0.0);
    assert!(free > 0.0);
    // σ²/(σ² + finest²): everything if finest is far below a pixel, next to nothing far above.
    assert!((moved(1e-4) - free).abs() < 0.02 * free);
    assert!(moved(1e4) < 0.02 * free);
}
