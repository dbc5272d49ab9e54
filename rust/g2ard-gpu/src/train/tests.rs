//! Steps on the device against the CPU's.

use g2ard_core::random::Lcg;
use g2ard_core::raster::{Camera, Image, Isa, Params, Rasterizer, Settings};
use g2ard_core::train::{Rates, Regularizers, Store, Trainer as Cpu};
use g2ard_core::{Error, Splats};

use super::*;
use crate::runtime::Work;
use crate::testing::{gpu, gpu_in_pieces, scenes};

/// Gaussians as trainers take them.
struct Arrays {
    means: Vec<f32>,
    quats: Vec<f32>,
    log_scales: Vec<f32>,
    logits: Vec<f32>,
    sh0: Vec<f32>,
    sh_n: Vec<f32>,
    coeffs: usize,
}

impl Arrays {
    fn of(splats: &Splats) -> Self {
        let coeffs = splats.sh_coeffs;
        let sh = |from, to| {
            let rows = splats.sh.chunks(coeffs);
            rows.flat_map(move |row| row[from..to].as_flattened())
                .copied()
                .collect()
        };
        let log = |scale: &f32| scale.ln().clamp(-30.0, 30.0);
        Self {
            means: splats
                .means
                .as_flattened()
                .iter()
                .map(|&v| v as f32)
                .collect(),
            quats: splats.quats.as_flattened().to_vec(),
            log_scales: splats.scales.as_flattened().iter().map(log).collect(),
            logits: splats.logit_opacities.clone(),
            sh0: sh(0, 1),
            sh_n: sh(1, coeffs),
            coeffs,
        }
    }

    /// Random Gaussians in a cube before the camera, some at its edge or behind it.
    fn random(count: usize, coeffs: usize, seed: u64) -> Self {
        let mut random = Lcg(seed);
        let mut draw = |columns: usize, low: f64, high: f64| -> Vec<f32> {
            (0..columns * count)
                .map(|_| random.between(low, high) as f32)
                .collect()
        };
        Self {
            means: draw(3, -2.2, 2.2),
            quats: draw(4, -1.0, 1.0),
            log_scales: draw(3, -4.5, -1.5),
            logits: draw(1, -5.0, 4.0),
            sh0: draw(3, -1.5, 1.5),
            sh_n: draw(3 * (coeffs - 1), -0.3, 0.3),
            coeffs,
        }
    }

    fn params(&self) -> Params<'_> {
        Params {
            means: &self.means,
            quats: &self.quats,
            log_scales: &self.log_scales,
            logit_opacities: &self.logits,
            sh0: &self.sh0,
            sh_n: &self.sh_n,
            sh_coeffs: self.coeffs,
            bounds: None,
        }
    }

    fn on(&self, gpu: &Arc<Gpu>) -> Trainer {
        let start = Store::new(&self.params(), None).unwrap().export();
        Trainer::new(gpu.clone(), &start, self.coeffs).unwrap()
    }

    fn here(&self) -> Cpu {
        Cpu::new(&self.params(), None, Isa::detect()).unwrap()
    }
}

/// A view of the origin from `distance` away, turned a little; no side is a whole number of tiles.
fn camera(width: usize, height: usize, distance: f64) -> Camera {
    let (s, c) = 0.3_f64.sin_cos();
    Camera {
        viewmat: [
            [c, 0.0, s, 0.05],
            [0.0, 1.0, 0.0, -0.02],
            [-s, 0.0, c, distance],
        ],
        fx: 1.1 * width as f64,
        fy: 1.1 * width as f64,
        cx: width as f64 / 2.0 + 0.3,
        cy: height as f64 / 2.0 - 0.7,
        width,
        height,
        near: 0.01,
    }
}

fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut random = Lcg(seed);
    (0..count).map(|_| random.uniform_f32()).collect()
}

const RATES: Rates = Rates {
    means: 2e-3,
    quats: 1e-2,
    log_scales: 2e-2,
    logit_opacities: 5e-2,
    sh0: 2e-2,
    sh_n: 2e-3,
    momentum: 0.6,
};

fn input<'a>(camera: &'a Camera, target: &'a [f32]) -> StepInput<'a> {
    StepInput {
        camera,
        settings: Settings::default(),
        background: [0.1, 0.2, 0.3],
        target,
        mask: None,
        view: None,
        ssim_weight: 0.2,
        relative: None,
        rates: RATES,
        reach: None,
        finest: 0.0,
        regularizers: None,
    }
}

fn target_of(camera: &Camera) -> Vec<f32> {
    noise(3 * camera.width * camera.height, 9)
}

fn image_there(trainer: &mut Trainer, input: &StepInput) -> Vec<f32> {
    trainer.step(input).unwrap();
    let held = trainer.held.get().unwrap();
    let frame = held.view.frame.as_ref().unwrap();
    let values = 3 * input.camera.width * input.camera.height;
    let read = Work::new(&held.gpu).submit(&[(&frame.image, values)]);
    let words = read.unwrap().take().unwrap().swap_remove(0);
    words.into_iter().map(f32::from_bits).collect()
}

fn image_here(params: &Params, input: &StepInput) -> Vec<f32> {
    let pixels = input.camera.width * input.camera.height;
    let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
    let mut image = Image {
        rgb: &mut rgb,
        alpha: &mut alpha,
        depth: None,
        median: None,
    };
    let (settings, background) = (&input.settings, input.background);
    Rasterizer::default()
        .forward(params, input.camera, settings, background, &mut image)
        .unwrap();
    rgb
}

/// Scenes, with a camera that sees each.
fn cases() -> Vec<(&'static str, Arrays, Camera)> {
    let mut all: Vec<_> = scenes(1500)
        .into_iter()
        .filter(|(name, _)| *name != "at UTM offsets") // callers centre the scene
        .map(|(name, splats)| (name, Arrays::of(&splats), camera(150, 101, 8.0)))
        .collect();
    for coeffs in [1, 9, 16] {
        let arrays = Arrays::random(1500, coeffs, coeffs as u64);
        all.push(("random", arrays, camera(75, 130, 3.0)));
    }
    all
}

/// Check that two images are the same within rounding.
fn compare_images(what: &str, want: &[f32], got: &[f32]) {
    assert_eq!(want.len(), got.len(), "{what}");
    let apart = want.iter().zip(got).map(|(a, b)| (a - b).abs());
    let most = apart.fold(0f32, f32::max);
    eprintln!("{what}: {most:.1e}");
    assert!(most <= 1e-5 && got.iter().all(|v| v.is_finite()), "{what}");
}

#[test]
fn images_are_the_cpus() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    for (name, arrays, camera) in cases() {
        let mut alone = Images::new(gpu.clone(), &arrays.params()).unwrap();
        let (near, alpha_max) = (camera.near, Settings::default().alpha_max);
        for (antialiased, near, alpha_max) in [
            (false, near, alpha_max),
            (true, near, alpha_max),
            (false, 7.9, 0.999),
        ] {
            let camera = Camera { near, ..camera };
            let target = target_of(&camera);
            let settings = Settings {
                antialiased,
                alpha_max,
                ..Settings::default()
            };
            let input = StepInput {
                settings,
                ..input(&camera, &target)
            };
            let want = image_here(&arrays.params(), &input);
            let what = format!("{name}, antialiased {antialiased}, near {near}");
            let got = alone.draw(&camera, &settings, input.background).unwrap();
            compare_images(&what, &want, &got);
            let got = image_there(&mut arrays.on(&gpu), &input);
            compare_images(&format!("{what}, of a step"), &want, &got);
        }
    }
}

#[test]
fn images_of_any_size_follow_each_other_with_the_same_bytes() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    // Each of a few wide Gaussians meets all tiles: more pairs than there is room for at first.
    let mut arrays = Arrays::random(60, 4, 4);
    arrays.log_scales.fill(0.5);
    let views = [(16, 16), (1, 1), (500, 300), (17, 200), (300, 17)];
    let run = || {
        let mut there = Images::new(gpu.clone(), &arrays.params()).unwrap();
        views.map(|(width, height)| {
            let camera = camera(width, height, 3.0);
            let background = [0.1, 0.2, 0.3];
            let got = there.draw(&camera, &Settings::default(), background);
            let want = image_here(&arrays.params(), &input(&camera, &target_of(&camera)));
            let got = got.unwrap();
            compare_images(&format!("{width}×{height}"), &want, &got);
            got
        })
    };
    let first = run();
    assert!(run() == first);
}

/// Largest difference of gradients, as a share of the row's largest of the same kind.
fn apart(want: &Exported, got: &Exported, coeffs: usize) -> Vec<(&'static str, Vec<f64>)> {
    let all = 11 + 3 * coeffs;
    let kinds = [
        ("means", 0..3),
        ("quats", 3..7),
        ("log_scales", 7..10),
        ("logits", 10..11),
        ("sh0", 11..14),
        ("shN", 14..all),
    ];
    kinds
        .into_iter()
        .map(|(name, columns)| {
            let rows = want.first.chunks(all).zip(got.first.chunks(all));
            let shares = rows.filter_map(|(a, b)| {
                let (a, b) = (&a[columns.clone()], &b[columns.clone()]);
                let largest = a.iter().fold(0f32, |m, v| m.max(v.abs()));
                let most = a.iter().zip(b).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
                (largest > 0.0).then(|| f64::from(most / largest))
            });
            (name, shares.collect())
        })
        .collect()
}

#[test]
fn gradients_are_the_cpus() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    for (name, arrays, camera) in cases() {
        let target = target_of(&camera);
        let input = input(&camera, &target);
        let (mut here, mut there) = (arrays.here(), arrays.on(&gpu));
        let (want, got) = (here.step(&input).unwrap(), there.step(&input).unwrap());
        assert!(
            (want.loss - got.loss).abs() <= 1e-6,
            "{name}: {want:?} {got:?}"
        );
        assert!(
            want.updated.abs_diff(got.updated) <= 2,
            "{name}: {want:?} {got:?}"
        );
        let (want, got) = (here.export().unwrap(), there.export().unwrap());
        for (kind, mut shares) in apart(&want, &got, arrays.coeffs) {
            shares.sort_by(f64::total_cmp);
            let Some(most) = shares.last() else { continue };
            let nearly_all = shares[99 * (shares.len() - 1) / 100];
            eprintln!("{name}: {kind} {nearly_all:.1e} of the row's largest, {most:.1e} at most");
            // A sum of cancelling terms, such as the logit's, has fewer digits.
            assert!(nearly_all <= 1e-4 && *most <= 0.02, "{name}: {kind}");
        }
    }
}

/// Check that a few steps with an option give the CPU's parameters. Adam turns a gradient that is lost in rounding into
/// a full step, so a few values may differ.
fn compare_steps(
    gpu: &Arc<Gpu>,
    what: &str,
    arrays: &Arrays,
    input: &StepInput,
    set: impl Fn(&mut dyn Train),
) {
    let (mut here, mut there) = (arrays.here(), arrays.on(gpu));
    set(&mut here);
    set(&mut there);
    let start = here.export().unwrap();
    for _ in 0..3 {
        let (want, got) = (here.step(input).unwrap(), there.step(input).unwrap());
        assert!(
            (want.loss - got.loss).abs() <= 1e-4 * want.loss,
            "{what}: {want:?} {got:?}"
        );
        assert!(
            want.updated.abs_diff(got.updated) <= 2,
            "{what}: {want:?} {got:?}"
        );
    }
    let (want, got) = (here.export().unwrap(), there.export().unwrap());
    let pairs = want.values.iter().zip(&got.values).zip(&start.values);
    let moved = pairs.clone().filter(|((a, _), s)| a != s).count();
    assert!(moved > 100, "{what}: {moved}");
    let off = pairs.filter(|((a, b), s)| (*a - *b).abs() > 0.02 * (*a - *s).abs() + 1e-6);
    let off = off.count() as f64 / moved as f64;
    eprintln!("{what}: {off:.5} of {moved} moved values differ");
    assert!(off <= 0.01, "{what}: {off}");
    let steps = want.steps.iter().zip(&got.steps);
    assert!(steps.filter(|(a, b)| a != b).count() <= 2, "{what}");
}

#[test]
fn every_option_is_the_cpus() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    let arrays = Arrays::random(800, 9, 5);
    let camera = camera(75, 50, 3.0);
    let target = target_of(&camera);
    let plain = input(&camera, &target);
    let compare = |what: &str, input: &StepInput| compare_steps(&gpu, what, &arrays, input, |_| ());
    compare("plain", &plain);
    let mask: Vec<bool> = (0..75 * 50).map(|i| i % 75 > 20 && i / 75 < 40).collect();
    let mask = Some(&mask[..]);
    compare("mask", &StepInput { mask, ..plain });
    let none = vec![false; 75 * 50];
    let (mut here, mut there) = (arrays.here(), arrays.on(&gpu));
    let mask = Some(&none[..]);
    let input = StepInput { mask, ..plain };
    assert_eq!(here.step(&input).unwrap(), there.step(&input).unwrap());
    let relative = Some(0.02);
    compare("relative", &StepInput { relative, ..plain });
    let (reach, finest) = (Some(6.0), 2.0);
    let limited = StepInput {
        reach,
        finest,
        ..plain
    };
    compare("reach and finest", &limited);
    for ssim_weight in [0.0, 1.0] {
        compare(
            "ssim",
            &StepInput {
                ssim_weight,
                ..plain
            },
        );
    }
    let settings = Settings {
        antialiased: true,
        alpha_max: 0.999,
        transmittance_min: 1e-3,
        ..plain.settings
    };
    compare("settings", &StepInput { settings, ..plain });
    let freeze = |trainer: &mut dyn Train| {
        let frozen: Vec<bool> = (0..800).map(|i| i % 3 == 0).collect();
        trainer.freeze(&frozen).unwrap();
    };
    compare_steps(&gpu, "frozen", &arrays, &plain, freeze);
    let anchors = Arrays::random(800, 1, 6);
    let noise =
        |count, seed| -> Vec<f32> { noise(count, seed).iter().map(|v| 0.3 * v + 0.01).collect() };
    let (parallel, perp) = (noise(800, 1), noise(800, 2));
    let rotation = |q: &[f32]| {
        let q = [0, 1, 2, 3].map(|k| f64::from(q[k]));
        g2ard_core::linalg::rotation_from_quat(q).map(|row| row.map(|v| v as f32))
    };
    let frames: Vec<_> = anchors.quats.chunks(4).flat_map(rotation).collect();
    let anchor = |trainer: &mut dyn Train| {
        let frames = frames.as_flattened();
        trainer
            .set_anchors(&anchors.means, frames, &parallel, &perp)
            .unwrap();
    };
    for (anchor_weight, shape, effective_rank, thickness) in [
        (5.0, 0.0, false, 1.0),
        (0.0, 3.0, false, 1.0),
        (0.0, 3.0, true, 0.0),
        (5.0, 3.0, true, 0.2),
    ] {
        let regularizers = Some(Regularizers {
            anchor: anchor_weight,
            shape,
            effective_rank,
            thickness,
            ..Regularizers::default()
        });
        let what = format!("{regularizers:?}");
        let input = StepInput {
            regularizers,
            ..plain
        };
        compare_steps(&gpu, &what, &arrays, &input, anchor);
    }
}

#[test]
fn gradients_are_finite_differences() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    let arrays = Arrays::random(150, 4, 3);
    let camera = camera(40, 30, 3.0);
    let target = target_of(&camera);
    let input = StepInput {
        rates: Rates::default(),
        ..input(&camera, &target)
    };
    let mut trainer = arrays.on(&gpu);
    trainer.step(&input).unwrap();
    let start = trainer.export().unwrap();
    let all = 11 + 3 * arrays.coeffs;
    // Along the gradient, where kinks (α's limits, |e|) count least.
    for (kind, columns, by) in [
        ("means", 0..3, 1e-3),
        ("quats", 3..7, 2e-3),
        ("log_scales", 7..10, 2e-3),
        ("logits", 10..11, 5e-3),
        ("sh0", 11..14, 5e-3),
        ("shN", 14..all, 5e-3),
    ] {
        let within = |at: usize| columns.contains(&(at % all));
        let gradient: Vec<f64> = (start.first.iter().enumerate())
            .map(|(at, m)| {
                if within(at) {
                    f64::from(*m) / f64::from(1.0 - input.rates.momentum)
                } else {
                    0.0
                }
            })
            .collect();
        let length = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
        let most = gradient.iter().fold(0f64, |most, g| most.max(g.abs()));
        let mut loss = |sign: f64| {
            let step = gradient.iter().map(|g| sign * by * g / most);
            let values = start.values.iter().zip(step);
            let values = values.map(|(v, d)| (f64::from(*v) + d) as f32).collect();
            let moved = Exported {
                values,
                ..start.clone()
            };
            trainer.import(&moved).unwrap();
            trainer.step(&input).unwrap().loss
        };
        let slope = (loss(1.0) - loss(-1.0)) / (2.0 * by / most) / length;
        eprintln!("{kind}: {slope:.3e} against {length:.3e}");
        assert!((slope - length).abs() <= 0.05 * length, "{kind}");
    }
}

#[test]
fn runs_give_the_same_bytes() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    let arrays = Arrays::random(2000, 9, 8);
    let views = [camera(75, 50, 3.0), camera(50, 90, 4.0)];
    let run = || {
        let mut trainer = arrays.on(&gpu);
        let step = |i: usize| {
            let view = &views[i % 2];
            trainer.step(&input(view, &target_of(view))).unwrap()
        };
        let reports: Vec<Report> = (0..6).map(step).collect();
        (reports, trainer.export().unwrap())
    };
    let first = run();
    for _ in 0..3 {
        assert!(run() == first);
    }
}

#[test]
fn targets_that_stay_change_no_bit() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    let arrays = Arrays::random(500, 4, 8);
    let views = [
        camera(75, 50, 3.0),
        camera(50, 90, 4.0),
        camera(40, 40, 3.0),
    ];
    let masks = [(75, 50), (50, 90)].map(|(w, h)| {
        let mask: Vec<bool> = (0..w * h).map(|i| i % w > 20).collect();
        mask
    });
    let one = 4 * 3 * 75 * 50 + 75 * 50;
    let run = |number: fn(usize) -> Option<u32>, room: usize| {
        let mut trainer = arrays.on(&gpu);
        trainer.held.get_mut().unwrap().targets = Targets::within(room);
        let reports: Vec<Report> = (0..9)
            .map(|i| {
                let target = target_of(&views[i % 3]);
                let step = StepInput {
                    mask: masks.get(i % 3).map(|mask| &mask[..]),
                    view: number(i % 3),
                    ..input(&views[i % 3], &target)
                };
                trainer.step(&step).unwrap()
            })
            .collect();
        let count = trainer.held.get().unwrap().targets.count();
        (count, reports, trainer.export().unwrap())
    };
    let sent = run(|_| None, 1 << 20);
    assert_eq!(sent.0, 0);
    for (room, count) in [(1 << 20, 3), (one, 1), (one - 1, 1), (16, 0)] {
        let kept = run(|i| Some(i as u32), room);
        assert_eq!(kept.0, count, "{room}");
        assert!(
            (kept.1, kept.2) == (sent.1.clone(), sent.2.clone()),
            "{room}"
        );
    }
}

#[test]
fn views_of_any_size_follow_each_other() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    // Each of a few wide Gaussians meets all tiles: more pairs than there is room for at first.
    let mut arrays = Arrays::random(60, 1, 4);
    arrays.log_scales.fill(0.5);
    let (mut here, mut there) = (arrays.here(), arrays.on(&gpu));
    for (width, height) in [(16, 16), (1, 1), (500, 300), (17, 200), (300, 17)] {
        let camera = camera(width, height, 3.0);
        let target = target_of(&camera);
        let input = input(&camera, &target);
        let (want, got) = (here.step(&input).unwrap(), there.step(&input).unwrap());
        assert!(
            (want.loss - got.loss).abs() <= 1e-4 * want.loss,
            "{want:?} {got:?}"
        );
        assert!(want.updated.abs_diff(got.updated) <= 1, "{want:?} {got:?}");
    }
}

#[test]
fn what_a_device_cannot_do_is_an_error_and_its_state_goes_on_elsewhere() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    let arrays = Arrays::random(300, 4, 7);
    let camera = camera(40, 30, 3.0);
    let target = target_of(&camera);
    let input = input(&camera, &target);
    let mut there = arrays.on(&gpu);
    there.step(&input).unwrap();
    let inria = StepInput {
        settings: Settings {
            convention: Convention::Inria,
            ..Settings::default()
        },
        ..input
    };
    assert!(matches!(
        there.step(&inria),
        Err(Error::InvalidInput { .. })
    ));
    let state = there.export().unwrap();
    let mut here = arrays.here();
    here.import(&state).unwrap();
    assert!(here.export().unwrap() == state);
    let want = there.step(&input).unwrap();
    let got = here.step(&input).unwrap();
    assert!((want.loss - got.loss).abs() <= 1e-5 * want.loss);
    there.held.fork();
    assert!(matches!(there.step(&input), Err(Error::Device(_))));
    there.held.fork();
    gpu.lose();
    assert!(matches!(there.step(&input), Err(Error::Device(_))));
    assert!(matches!(there.export(), Err(Error::Device(_))));
    let Some(small) = gpu_in_pieces(1 << 12).map(Arc::new) else {
        return;
    };
    let start = Store::new(&arrays.params(), None).unwrap().export();
    assert!(Trainer::new(small, &start, 4).is_err());
}

#[test]
fn more_splats_in_a_tile_than_a_thread_can_draw_are_an_error() {
    let Some(gpu) = gpu().map(Arc::new) else {
        return;
    };
    if !gpu.adapter.is_software() {
        return; // no limit
    }
    let mut arrays = Arrays::random(50_000, 1, 2);
    arrays.means.fill(0.0);
    let camera = camera(16, 16, 3.0);
    let target = target_of(&camera);
    let found = arrays.on(&gpu).step(&input(&camera, &target));
    assert!(matches!(found, Err(Error::Device(_))), "{found:?}");
    let mut alone = Images::new(gpu, &arrays.params()).unwrap();
    let found = alone.draw(&camera, &Settings::default(), [0.0; 3]);
    assert!(found.unwrap_err().is_of_size());
}
