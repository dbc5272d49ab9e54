use std::collections::HashSet;
use std::sync::Arc;

use super::*;
use crate::runtime::Kernel;
use crate::testing::{WHOLE, borrowed, compare_on_gpu, gpu, scenes};
use g2ard_core::random::Lcg;
use g2ard_core::raster::ALPHA_MIN;
use g2ard_core::raster::visibility::VisibilityKernels;
use g2ard_core::scene::Ordered;
use g2ard_core::select::ViewKernels;
use g2ard_core::{Cpu, Splats};

/// Cameras all around, within, and far away.
fn cameras(center: [f64; 3], radius: f64) -> Vec<Camera> {
    (0..6)
        .map(|i| {
            let (a, d) = (f64::from(i) * 1.1, radius * [2.0, 1.2, 0.3][i as usize % 3]);
            let (s, c) = a.sin_cos();
            let turn = [
                [c, -s, 0.0],
                [-0.3 * s, -0.3 * c, -0.953_939_201_416_945_7],
                [
                    0.953_939_201_416_945_7 * s,
                    0.953_939_201_416_945_7 * c,
                    -0.3,
                ],
            ];
            let shift = |r: usize| {
                let at: f64 = (0..3).map(|k| turn[r][k] * center[k]).sum();
                if r == 2 { d - at } else { -at }
            };
            Camera {
                viewmat: [0, 1, 2].map(|r| [turn[r][0], turn[r][1], turn[r][2], shift(r)]),
                fx: 150.0,
                fy: 160.0,
                cx: 71.0,
                cy: 49.5,
                width: 150,
                height: 101,
                near: 0.01,
            }
        })
        .collect()
}

/// Largest difference of Σ αT² summed over all Gaussians, as a share of that sum; and the share of Gaussians that may
/// differ by over a thousandth, because their order by depth is within rounding.
const TOLERANCE: f64 = 1e-5;

fn compare_weights(gpu: &Gpu, what: &str, splats: &Splats, cameras: &[Camera]) {
    let scene = borrowed(splats);
    let ordered = Arc::new(Ordered::new(&scene).unwrap());
    let control = Control::default();
    let settings = Settings::default();
    let mut sums = VisibilityAccumulator::new(&scene, ordered.clone()).unwrap();
    Cpu.add_views(&mut sums, cameras, &settings, &control)
        .unwrap();
    let want = sums.by_row();
    let mut sums = VisibilityAccumulator::new(&scene, ordered).unwrap();
    for part in cameras.chunks(4) {
        let got = weights(gpu, &mut sums, part, &settings, &control).unwrap();
        sums.add_sums(part, &got);
    }
    let got = sums.by_row();
    assert_eq!(want.1, got.1, "sizes of pixels");
    let total: f64 = want.0.iter().map(|&w| f64::from(w)).sum();
    let pairs = want.0.iter().zip(&got.0);
    let apart = pairs.clone().map(|(a, b)| f64::from((a - b).abs()));
    let apart = apart.sum::<f64>() / total.max(1.0);
    let off = pairs.filter(|(a, b)| (*a - *b).abs() > 1e-3 * **a + 1e-3);
    let off = off.count() as f64 / splats.len() as f64;
    eprintln!("{what}: Σ αT² {apart:.1e} apart, {off:.5} of the rows by more than 0.001");
    assert!(apart <= TOLERANCE && off <= 1e-3, "{what}");
}

fn compare(gpu: &Gpu) {
    let control = Control::default();
    let (mut same, mut all) = (0, 0);
    for (name, splats) in scenes(6000) {
        let (center, radius) = match name {
            "at UTM offsets" => continue, // callers centre the scene
            _ => ([0.0, 0.0, 0.5], 5.0),
        };
        let opacities: Vec<f32> = splats
            .logit_opacities
            .iter()
            .map(|&x| 1.0 / (1.0 + (-x).exp()))
            .collect();
        let scene = Gaussians {
            means: &splats.means,
            quats: &splats.quats,
            scales: &splats.scales,
            opacities: &opacities,
        };
        let surface = Surface::of(&scene, 2000).unwrap();
        let cameras = cameras(center, radius);
        let want = Cpu
            .visible_cells(&scene, &surface, 0.02, &cameras, &control)
            .unwrap();
        let got = visible_cells(gpu, &scene, &surface, 0.02, &cameras, &control).unwrap();
        let set = |cells: &Vec<u32>| cells.iter().copied().collect::<HashSet<_>>();
        let pairs = want.iter().zip(&got);
        let equal: usize = pairs
            .map(|(a, b)| surface.len() - set(a).symmetric_difference(&set(b)).count())
            .sum();
        let cells = surface.len() * cameras.len();
        let seen: usize = want.iter().map(Vec::len).sum();
        eprintln!("{name}: {equal} of {cells} cells alike, {seen} of them seen");
        same += equal;
        all += cells;
        let want = Cpu.view_statistics(&scene, &cameras, &control).unwrap();
        let got = view_statistics(gpu, &scene, &cameras, &control).unwrap();
        for (a, b) in want.iter().zip(&got) {
            // For the widest needles, the CPU's determinants in f32 have no correct digit.
            let close =
                |k: usize| (a[k] - b[k]).abs() <= 1e-4 * a[k].abs() || name.contains("wild");
            assert!(close(0) && close(1), "{name}: {a:?} {b:?}");
        }
        compare_weights(gpu, name, &splats, &cameras);
    }
    let share = same as f64 / all as f64;
    eprintln!("{:.4} % of visible sets equal", 100.0 * share);
    assert!(share >= 0.9999);
}

#[test]
fn views_see_what_they_see_on_the_cpu_also_when_pairs_are_drawn_in_turns() {
    compare_on_gpu(&[WHOLE, 1 << 19], compare);
}

#[test]
fn a_crowded_tile_is_drawn_to_its_end() {
    let Some(gpu) = gpu() else { return };
    // A crowd in one corner, and an image-filling background behind it.
    let mut means = vec![[-0.49, -0.49, 0.0]; 70_000];
    means.push([0.0, 0.0, 1.0]);
    let n = means.len();
    let mut scales = vec![[0.01f32; 3]; n];
    scales[n - 1] = [2.0, 2.0, 0.01];
    let scene = Gaussians {
        means: &means,
        quats: &vec![[1.0, 0.0, 0.0, 0.0]; n],
        scales: &scales,
        opacities: &vec![0.9; n],
    };
    let camera = Camera {
        viewmat: [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 1.0],
        ],
        fx: 16.0,
        fy: 16.0,
        cx: 8.0,
        cy: 8.0,
        width: 16,
        height: 16,
        near: 0.01,
    };
    let control = Control::default();
    let want = Cpu.view_statistics(&scene, &[camera], &control).unwrap();
    assert_eq!(want, [[1.0, 2.0]]);
    assert_eq!(
        view_statistics(&gpu, &scene, &[camera], &control).unwrap(),
        want
    );
}

#[test]
fn points_near_a_far_camera_keep_their_digits() {
    let Some(gpu) = gpu() else { return };
    let camera = Camera {
        viewmat: cameras([691_234.567, 5_334_567.891, 512.3], 5.0)[0].viewmat,
        ..cameras([0.0; 3], 5.0)[0]
    };
    let view = View::of(&camera, &MEDIAN).unwrap();
    let mut random = Lcg(6);
    let eye = camera.position();
    let points: Vec<_> = (0..1000)
        .map(|_| eye.map(|v| (v + 9.0 * random.centred()) as f32))
        .collect();
    let body = "
        @group(0) @binding(1) var<storage, read> points: array<array<f32, 3>>;
        @group(0) @binding(2) var<storage, read_write> found: array<array<f32, 3>>;

        @compute @workgroup_size(64)
        fn each(@builtin(global_invocation_id) id: vec3<u32>) {
            if id.x >= arrayLength(&points) { return; }
            let p = points[id.x];
            let t = to_camera(vec3(p[0], p[1], p[2]));
            found[id.x] = array(t.x, t.y, t.z);
        }";
    let sources = Vec::leak(vec![include_str!("pinhole.wgsl"), body]);
    let kernel = Kernel::new("test.to_camera", sources, "each");
    let input = gpu.upload("points", &points).unwrap();
    let found = gpu.buffer("found", 3 * points.len()).unwrap();
    let mut work = Work::new(&gpu);
    let groups = points.len().div_ceil(64);
    work.run(&kernel, groups, view.words(), &[&input, &found])
        .unwrap();
    let words = work.submit(&[(&found, 3 * points.len())]).unwrap().take();
    for (point, got) in points.iter().zip(words.unwrap()[0].chunks(3)) {
        for (row, &got) in camera.viewmat.iter().zip(got) {
            let want: f64 = (0..3)
                .map(|k| row[k] * (f64::from(point[k]) - eye[k]))
                .sum();
            let apart = (f64::from(f32::from_bits(got)) - want).abs();
            assert!(apart < 1e-5, "{point:?}: {apart}");
        }
    }
}

/// `bounded` of `pinhole.wgsl`.
fn bounded(x: f32, most: f32) -> bool {
    x.to_bits() < most.to_bits()
}

#[test]
fn bounds_by_bits_refuse_what_is_negative_infinite_or_no_number() {
    for most in [1e30_f32, 1e33] {
        for x in [0.0, f32::MIN_POSITIVE / 2.0, 1.0, 0.999_999 * most] {
            assert!(bounded(x, most), "{x}");
        }
        for x in [
            most,
            f32::MAX,
            f32::INFINITY,
            f32::NAN,
            -f32::NAN,
            -0.0,
            -1.0,
        ] {
            assert!(!bounded(x, most), "{x}");
        }
    }
}

/// `span` of `mark.wgsl`, with conversions that must be in range.
fn span(at: f32, reach: f32, count: u32) -> Option<[u32; 2]> {
    let whole = |x: f32| {
        assert!(
            (0.0..=32769.0).contains(&x),
            "{x} is no u32 on every device"
        );
        x as u32
    };
    let last = count as f32;
    let low = (at - reach - 0.5).max(-1.0).min(last);
    let high = (at + reach - 0.5).max(-1.0).min(last);
    let start = whole(low.ceil().max(0.0));
    let end = whole((high.floor() + 1.0).max(0.0)).min(count);
    (start < end).then_some([start, end])
}

#[test]
fn spans_are_the_pixels_within_reach() {
    let mut random = Lcg(7);
    let sizes = [1, 16, 150, 32768];
    for case in 0..20_000 {
        let count = sizes[case % sizes.len()];
        let at = (2.0 * random.uniform() - 0.5) as f32 * count as f32;
        let reach = (10.0_f64.powf(6.0 * random.uniform() - 3.0)) as f32;
        let inside = |p: u32, slack: f64| {
            (f64::from(p) + 0.5 - f64::from(at)).abs() <= f64::from(reach) + slack
        };
        let slack = 1e-2 + 1e-6 * f64::from(at.abs() + reach);
        let [start, end] = span(at, reach, count).unwrap_or([0, 0]);
        assert!((start..end).all(|p| inside(p, slack)), "{at} ± {reach}");
        let beside = [
            start.checked_sub(1),
            Some(end).filter(|&p| p < count && start < end),
        ];
        let outside = beside.into_iter().flatten();
        assert!(
            outside.into_iter().all(|p| !inside(p, -slack)),
            "{at} ± {reach}"
        );
    }
    for at in [-1e30, -1e9, 1e9, 1e30] {
        assert_eq!(span(at, 1.0, 100), None);
        assert_eq!(span(at, 4e30, 100), Some([0, 100]));
    }
}

#[test]
fn the_limit_of_exponents_is_below_what_counts() {
    let least = 2.0_f32.powi(-126);
    assert!(least.is_normal());
    for off in [1.0 - 2e-6, 1.0, 1.0 + 2e-6] {
        assert!(0.999 * least * off < ALPHA_MIN);
    }
    for power in [126.0, 200.0, 1e30, f32::INFINITY] {
        assert_eq!((-power.min(126.0_f32)).exp2(), least);
    }
}
