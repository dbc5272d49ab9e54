//! The device as callers use it: the paper's method as a whole, and every way in which a device fails.

use g2ard_core::random::Lcg;
use g2ard_core::scene::{Means, Ordered, SceneRef};
use g2ard_core::simplify::{Outcome, Paper, PaperPlan, PaperRound};
use g2ard_core::{Backend, Control, Cpu};
use g2ard_gpu::runtime::{Error, Gpu, Options, list};
use g2ard_gpu::{Choice, Device};

struct Scene {
    means: Vec<[f64; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    logits: Vec<f32>,
    sh: Vec<[f32; 3]>,
}

/// A wavy sheet at UTM offsets.
fn scene(count: usize) -> Scene {
    let mut random = Lcg(3);
    let mut next = || random.centred();
    let mut scene = Scene {
        means: Vec::new(),
        quats: Vec::new(),
        scales: Vec::new(),
        logits: Vec::new(),
        sh: Vec::new(),
    };
    for _ in 0..count {
        let (x, y) = (20.0 * next(), 20.0 * next());
        let z = (0.4 * x).sin() + 0.05 * next();
        scene
            .means
            .push([691_234.5 + x, 5_334_567.75 + y, 512.0 + z]);
        scene.quats.push([0; 4].map(|_| next() as f32));
        scene
            .scales
            .push([0.2, 0.15, 0.01].map(|s| s * (1.5 * next()).exp() as f32));
        scene.logits.push((8.0 * next()) as f32);
        scene
            .sh
            .push([0; 3].map(|_| ((0.3 * x).sin() + 0.2 * next()) as f32));
    }
    scene
}

fn simplify(scene: &Scene, backend: &dyn Backend) -> Outcome<PaperRound> {
    let count = scene.means.len();
    let borrowed = SceneRef {
        means: Means::F64(&scene.means),
        quats: &scene.quats,
        scales: &scene.scales,
        logit_opacities: &scene.logits,
        sh0: &scene.sh,
        sh_rest: &[],
        rest: 0,
    };
    let plan = PaperPlan {
        schedule: &[3 * count / 4, count / 2, count / 5],
        cells: count / 5,
    };
    Paper::default()
        .run(
            &borrowed,
            &Ordered::new(&borrowed).unwrap(),
            None,
            plan,
            &*backend.group_kernels(),
            &Control::default(),
        )
        .unwrap()
}

fn adapter(what: &str) -> bool {
    let found = !list().is_empty();
    let skipped = std::env::var_os("G2ARD_NO_GPU_TESTS").is_some_and(|v| v == "1");
    assert!(
        found || skipped,
        "{what}: no adapter on this machine; install Mesa's lavapipe, or set G2ARD_NO_GPU_TESTS=1"
    );
    found
}

/// Check that the budget is exact and that rows come from the same rows. A group whose energy or coverage is within
/// rounding of its limit may be decided otherwise, and others then take its place.
fn assert_close(got: &Outcome<PaperRound>, want: &Outcome<PaperRound>) {
    assert_eq!(got.splats.means.len(), want.splats.means.len());
    let firsts = |parents: &[i64]| {
        let mut first = std::collections::HashMap::new();
        let rows = parents.iter().enumerate();
        rows.map(|(i, &p)| {
            if p < 0 {
                None
            } else {
                Some(*first.entry(p).or_insert(i))
            }
        })
        .collect::<Vec<_>>()
    };
    let (a, b) = (firsts(&got.parents), firsts(&want.parents));
    let alike = a.iter().zip(&b).filter(|(a, b)| a == b).count();
    eprintln!("paper: {alike} of {} rows go where the CPU's do", a.len());
    assert!(alike * 100 >= 99 * a.len());
}

#[test]
fn the_papers_policy_comes_to_nearly_the_same_scene() {
    if !adapter("the paper's policy") {
        return;
    }
    let scene = scene(5000);
    let options = Options {
        timed: true,
        ..Options::default()
    };
    let device = Device::new(Choice::Gpu, options);
    let (want, got) = (simplify(&scene, &Cpu), simplify(&scene, &device));
    let gpu = device.gpu().expect("an open device");
    let seconds = gpu.timings();
    assert_eq!(seconds.is_empty(), !gpu.adapter.timestamps);
    assert!(
        seconds.values().all(|s| (0.0..60.0).contains(s)),
        "{seconds:?}"
    );
    assert_eq!(device.notes(), Vec::<String>::new());
    assert!(device.served() >= 10, "{}", device.served());
    let refused: usize = want
        .rounds
        .iter()
        .map(|r| r.refused_energy + r.refused_coverage)
        .sum();
    let merged: usize = want.rounds.iter().map(|r| r.merged_groups).sum();
    assert!(merged > 100 && refused > 100);
    assert_close(&got, &want);
    assert_eq!(got, simplify(&scene, &device), "the same bits twice");
}

#[test]
fn a_lost_device_costs_one_line() {
    if !adapter("a lost device") {
        return;
    }
    let scene = scene(3000);
    let device = Device::new(Choice::Gpu, Options::default());
    let want = simplify(&scene, &Cpu);
    assert_close(&simplify(&scene, &device), &want);
    device.gpu().expect("an open device").lose();
    assert_eq!(simplify(&scene, &device), want);
    let notes = device.notes();
    assert_eq!(notes.len(), 1, "{notes:?}");
    assert!(
        notes[0].contains("lost") && notes[0].ends_with("goes on on the CPU"),
        "{notes:?}"
    );
    assert_eq!(device.adapter(), None);
}

#[test]
fn tiny_buffers_work_in_pieces_or_go_to_the_cpu() {
    if !adapter("tiny buffers") {
        return;
    }
    // The second limit is too small for a row.
    for (rows, bytes, refused) in [(700, 1 << 14, false), (60, 1 << 6, true)] {
        let scene = scene(rows);
        let want = simplify(&scene, &Cpu);
        let device = Device::new(
            Choice::Gpu,
            Options {
                max_binding: Some(bytes),
                ..Options::default()
            },
        );
        assert_close(&simplify(&scene, &device), &want);
        let notes = device.notes();
        assert_eq!(!notes.is_empty(), refused, "{bytes}: {notes:?}");
        assert!(
            notes.iter().all(|n| n.contains("binds 64 at most")),
            "{notes:?}"
        );
    }
}

#[test]
fn buffers_beyond_the_limit_are_refused_by_name() {
    if !adapter("buffer limits") {
        return;
    }
    let gpu = Gpu::open(
        true,
        Options {
            max_binding: Some(1024),
            ..Options::default()
        },
    )
    .unwrap();
    assert_eq!(gpu.buffer("rows", 256).map(|b| b.words()), Ok(256));
    let error = gpu.buffer("rows", 257).map(|b| b.words()).unwrap_err();
    assert_eq!(
        error,
        Error::TooLarge {
            what: "rows",
            bytes: 1028,
            limit: 1024
        }
    );
}

#[test]
fn the_cpu_is_never_left_by_small_scenes_or_for_software() {
    let scene = scene(500);
    for choice in [Choice::Cpu, Choice::Auto] {
        let device = Device::new(choice, Options::default());
        assert_eq!(simplify(&scene, &device), simplify(&scene, &Cpu));
        assert_eq!((device.served(), device.notes()), (0, Vec::new()));
    }
    if list().iter().all(|a| a.is_software()) {
        let error = Gpu::open(false, Options::default())
            .map(|_| ())
            .unwrap_err();
        assert_eq!(error, Error::NoAdapter);
    }
}
