use super::*;
use crate::raster::find_bounds::bounds_of;
use crate::raster::frustum::Frustum;
use crate::raster::params::Source;
use crate::raster::rasterizer::ChunkSums;
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

/// A view of one corner of the small scene, from within it.
fn corner(step: usize) -> Camera {
    let (s, c) = (0.9 * step as f64).sin_cos();
    let mut camera = camera();
    camera.viewmat = [
        [c, 0.0, s, 0.3],
        [0.0, 1.0, 0.0, -0.4],
        [-s, 0.0, c, 0.5 * (step % 3) as f64 - 0.7],
    ];
    (camera.fx, camera.fy) = (3.0 * camera.fx, 3.0 * camera.fy);
    camera
}

/// The bits of an image of the source, and those of the sums for its gradient, chunk by chunk with visible rows.
fn drawn<S: Source>(source: S, camera: &Camera) -> (Vec<u32>, Vec<Vec<u32>>) {
    let pixels = camera.width * camera.height;
    let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
    let mut image = Image {
        rgb: &mut rgb,
        alpha: &mut alpha,
        depth: None,
        median: None,
    };
    let (mut rasterizer, settings) = (Rasterizer::default(), Settings::default());
    rasterizer
        .forward_from(source, camera, &settings, [0.0; 3], &mut image)
        .unwrap();
    let gradients = ImageGradients {
        rgb: &noise(3 * pixels, 3),
        alpha: None,
        depth: None,
    };
    let sums = rasterizer.backward_by_chunk(&gradients, |chunk: &ChunkSums| {
        let groups = chunk.first_group..chunk.last_group;
        let rows = chunk.splats.iter().map(|splat| splat.row);
        assert!(
            rows.clone()
                .all(|row| groups.contains(&(row as usize / LANES)))
        );
        let written = chunk
            .slots
            .iter()
            .zip(chunk.written)
            .filter(|(_, w)| **w != 0);
        let written = written.flat_map(|(slot, _)| slot.map(f32::to_bits));
        rows.chain(written).collect::<Vec<u32>>()
    });
    let image = rgb.iter().chain(&alpha).map(|v| v.to_bits()).collect();
    (
        image,
        sums.into_iter().filter(|sum| !sum.is_empty()).collect(),
    )
}

#[test]
fn rows_out_of_view_are_skipped_without_a_trace() {
    let (scene, shape) = (Small::new(), camera());
    let target = noise(3 * shape.width * shape.height, 9);
    let mut trainer = Trainer::new(&scene.params(), None, Isa::detect()).unwrap();
    let (mut skipped, mut shown) = (0, 0);
    for step in 0..if cfg!(miri) { 2 } else { 12 } {
        let input = StepInput {
            camera: &corner(step),
            settings: Settings::default(),
            background: [0.1, 0.2, 0.3],
            target: &target,
            mask: None,
            view: None,
            ssim_weight: 0.2,
            relative: None,
            rates: Rates {
                means: 0.05, // far enough that rows leave the bounds before
                log_scales: 0.05,
                sh0: 0.02,
                momentum: 0.6,
                ..Rates::default()
            },
            reach: None,
            finest: 0.0,
            regularizers: None,
        };
        trainer.step(&input).unwrap();
        let (parameters, next) = (trainer.store.parameters(), corner(step + 1));
        let culled = drawn(parameters, &next);
        assert!(
            culled == drawn(parameters.unbounded(), &next),
            "step {step}"
        );
        shown += culled.1.len();
        let frustum = Frustum::of(&next);
        let bounds = parameters.bounds().unwrap();
        assert_eq!(bounds, bounds_of(&parameters.unbounded()), "step {step}");
        skipped += bounds
            .iter()
            .filter(|b| b.tile_rows(&frustum).is_none())
            .count();
    }
    assert!(
        cfg!(miri) || (skipped > 12 && shown > 12),
        "{skipped} bounds skipped, {shown} chunks shown"
    );
    let mut resumed = Store::new(&scene.params(), None).unwrap();
    let state = trainer.store.export();
    resumed.import(&state).unwrap();
    assert_eq!(Some(resumed.most_steps()), state.steps.into_iter().max());
    let bounds = |store: &Store| store.parameters().bounds().unwrap().to_vec();
    assert_eq!(bounds(&resumed), bounds(&trainer.store));
}

#[test]
fn anchors_pull_rows_out_of_view_too() {
    let (scene, shape) = (Small::new(), corner(0));
    let params = scene.params();
    let target = noise(3 * shape.width * shape.height, 9);
    let mut trainer = Trainer::new(&params, None, Isa::detect()).unwrap();
    // Every row lies outside the region of its anchor.
    let rows = params.logit_opacities.len();
    let away: Vec<f32> = params.means.iter().map(|v| v + 1.0).collect();
    let frames = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0].repeat(rows);
    let radii = vec![0.5; rows];
    trainer.set_anchors(&away, &frames, &radii, &radii).unwrap();
    let before = trainer.store.columns(0, 3);
    let input = StepInput {
        camera: &shape,
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
        finest: 0.0,
        regularizers: Some(Regularizers {
            anchor: 1.0,
            ..Regularizers::default()
        }),
    };
    let frustum = Frustum::of(&shape);
    let parameters = trainer.store.parameters();
    let bounds = parameters.bounds().unwrap();
    assert!(cfg!(miri) || bounds.iter().any(|b| b.tile_rows(&frustum).is_none()));
    trainer.step(&input).unwrap();
    let after = trainer.store.columns(0, 3);
    let moved = before.iter().zip(&after).filter(|(a, b)| a != b).count();
    assert_eq!(moved, 3 * rows);
}
