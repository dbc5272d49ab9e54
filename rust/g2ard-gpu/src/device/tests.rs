//! The device as callers use it: the paper's method as a whole, and every way in which a device fails.

use std::collections::HashMap;

use g2ard_core::scene::Ordered;
use g2ard_core::simplify::{Outcome, Paper, PaperPlan, PaperRound};

use super::*;
use crate::testing::{borrowed, gpu, scenes};

/// Two wavy sheets at UTM offsets.
fn scene(count: usize) -> Splats {
    scenes(count).swap_remove(1).1
}

fn simplify(scene: &Splats, backend: &dyn Backend) -> Outcome<PaperRound> {
    let (scene, count) = (borrowed(scene), scene.len());
    let plan = PaperPlan {
        schedule: &[3 * count / 4, count / 2, count / 5],
        cells: count / 5,
    };
    let ordered = Ordered::new(&scene).unwrap();
    let (kernels, control) = (backend.group_kernels(), Control::default());
    Paper::default()
        .run(&scene, &ordered, None, plan, &*kernels, &control)
        .unwrap()
}

/// A device that takes any adapter, or `None` on a machine without one, where tests skip.
fn device(options: Options) -> Option<Device> {
    gpu().map(|_| Device::new(Choice::Gpu, options))
}

/// Check that the budget is exact and that rows come from the same rows. A group whose energy or coverage is within
/// rounding of its limit may be decided otherwise, and others then take its place.
fn assert_close(got: &Outcome<PaperRound>, want: &Outcome<PaperRound>) {
    assert_eq!(got.splats.means.len(), want.splats.means.len());
    // Of each row the first one that goes where it goes.
    let firsts = |parents: &[i64]| -> Vec<Option<usize>> {
        let mut first = HashMap::new();
        let rows = parents.iter().enumerate();
        rows.map(|(i, &p)| (p >= 0).then(|| *first.entry(p).or_insert(i)))
            .collect()
    };
    let (a, b) = (firsts(&got.parents), firsts(&want.parents));
    let alike = a.iter().zip(&b).filter(|(a, b)| a == b).count();
    eprintln!("paper: {alike} of {} rows go where the CPU's do", a.len());
    assert!(alike * 100 >= 99 * a.len());
}

#[test]
fn the_papers_policy_comes_to_nearly_the_same_scene() {
    let scene = scene(5000);
    let options = Options {
        timed: true,
        ..Options::default()
    };
    let Some(device) = device(options) else {
        return;
    };
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
    let sum = |of: fn(&PaperRound) -> usize| want.rounds.iter().map(of).sum::<usize>();
    let refused = sum(|r| r.refused_energy + r.refused_coverage);
    let merged = sum(|r| r.merged_groups);
    assert!(merged > 100 && refused > 100, "{merged} {refused}");
    assert_close(&got, &want);
    assert_eq!(got, simplify(&scene, &device), "the same bits twice");
}

#[test]
fn a_lost_device_costs_one_line() {
    let Some(device) = device(Options::default()) else {
        return;
    };
    let scene = scene(3000);
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
    assert!(device.gpu().is_none());
}

#[test]
fn tiny_buffers_work_in_pieces_or_go_to_the_cpu() {
    // The second limit is too small for a row.
    for (rows, bytes, refused) in [(700, 1 << 14, false), (60, 1 << 6, true)] {
        let options = Options {
            max_binding: Some(bytes),
            ..Options::default()
        };
        let Some(device) = device(options) else {
            return;
        };
        let scene = scene(rows);
        assert_close(&simplify(&scene, &device), &simplify(&scene, &Cpu));
        let notes = device.notes();
        assert_eq!(!notes.is_empty(), refused, "{bytes}: {notes:?}");
        assert!(
            notes.iter().all(|n| n.contains("binds 64 at most")),
            "{notes:?}"
        );
    }
}

#[test]
fn the_cpu_is_never_left_by_small_scenes_or_for_software() {
    let scene = scene(500);
    for choice in [Choice::Cpu, Choice::Auto] {
        let device = Device::new(choice, Options::default());
        assert_eq!(simplify(&scene, &device), simplify(&scene, &Cpu));
        assert_eq!((device.served(), device.notes()), (0, Vec::new()));
    }
    if runtime::list().iter().all(|a| a.is_software()) {
        let error = Gpu::open(false, Options::default()).map(|_| ());
        assert_eq!(error, Err(Error::NoAdapter));
    }
}

#[test]
fn whatever_a_twin_ends_in_the_cpu_answers_and_one_line_says_why() {
    let name = || "a device".to_owned();
    let failures = [
        Error::NoDevice {
            name: name(),
            why: name(),
        },
        Error::OutOfMemory,
        Error::NoRoom { bytes: 2, left: 1 },
        Error::Lost(name()),
        Error::Timeout(30),
        Error::Refused(name()),
        Error::Panicked(name()),
        Error::Wrong(name()),
    ];
    for failure in failures {
        let Some(device) = device(Options::default()) else {
            return;
        };
        let why = failure.to_string();
        assert_eq!(device.either(1, |_| Err(failure), || Ok(7)).unwrap(), 7);
        assert_eq!(device.notes(), [format!("GPU: {why}; goes on on the CPU")]);
        assert!(device.gpu().is_none(), "left for good");
        assert_eq!(device.served(), 0);
    }
}

#[test]
fn what_is_too_large_for_one_kernel_is_no_reason_to_leave() {
    let Some(device) = device(Options {
        max_binding: Some(1 << 20),
        ..Options::default()
    }) else {
        return;
    };
    let gpu = device.ready(1).expect("an open device");
    let limit = gpu.max_words();
    assert_eq!(gpu.buffer("rows", limit).map(|b| b.words()), Ok(limit));
    let large = gpu.buffer("rows", limit + 1).map(|_| ()).unwrap_err();
    let told = "rows needs a buffer of 1048580 bytes; the device binds 1048576 at most";
    assert_eq!(large.to_string(), told);
    let many = Error::TooMany {
        what: "rows",
        count: 4,
        limit: 3,
    };
    let told = "4 rows are too many for the device, which takes 3 at most";
    assert_eq!(many.to_string(), told);
    for failure in [large, many] {
        assert_eq!(device.either(1, |_| Err(failure), || Ok(7)).unwrap(), 7);
        assert_eq!(device.notes().len(), 1);
        assert_eq!(device.either(1, |_| Ok(8), || Ok(7)).unwrap(), 8);
    }
}

#[test]
fn a_forked_process_leaves_its_parents_device_alone() {
    let Some(device) = device(Options::default()) else {
        return;
    };
    assert_eq!(device.either(1, |_| Ok(8), || Ok(7)).unwrap(), 8);
    let opened = Arc::downgrade(&device.gpu().expect("an open device"));
    if let State::Open(opened) = &mut *lock(&device.state) {
        opened.fork();
    }
    assert!(device.gpu().is_none());
    for _ in 0..2 {
        assert_eq!(device.either(1, |_| Ok(8), || Ok(7)).unwrap(), 7);
    }
    let notes = device.notes();
    assert_eq!(notes.len(), 1, "{notes:?}");
    assert!(notes[0].contains("spawn"), "{notes:?}");
    assert!(opened.upgrade().is_some(), "closed");
}

#[test]
fn a_stop_is_no_failure() {
    let Some(device) = device(Options::default()) else {
        return;
    };
    let found = device.either(1, |_| Err(Error::Interrupted), || Ok(7));
    assert_eq!(found.unwrap_err(), g2ard_core::Error::Interrupted);
    assert!(device.notes().is_empty());
}

/// Splats as trainers and renderers take them, on a wavy sheet before a camera.
struct Sheet {
    rows: [Vec<f32>; 5],
}

impl Sheet {
    fn new(count: usize) -> Self {
        let splats = scenes(count).swap_remove(0).1;
        let means = splats.means.as_flattened().iter().map(|&v| v as f32);
        let scales = splats.scales.as_flattened().iter().map(|v| v.ln());
        Self {
            rows: [
                means.collect(),
                splats.quats.as_flattened().to_vec(),
                scales.collect(),
                splats.logit_opacities.clone(),
                splats
                    .sh
                    .chunks(splats.sh_coeffs)
                    .flat_map(|sh| sh[0])
                    .collect(),
            ],
        }
    }

    fn params(&self) -> Params<'_> {
        let [means, quats, log_scales, logit_opacities, sh0] = &self.rows;
        Params {
            means,
            quats,
            log_scales,
            logit_opacities,
            sh0,
            sh_n: &[],
            sh_coeffs: 1,
            bounds: None,
        }
    }
}

fn image(
    device: &Device,
    drawn: &mut Drawn,
    sheet: &Sheet,
    settings: Settings,
) -> Option<Vec<f32>> {
    let camera = Camera {
        viewmat: [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 8.0],
        ],
        fx: 40.0,
        fy: 40.0,
        cx: 20.0,
        cy: 15.0,
        width: 40,
        height: 30,
        near: 0.01,
    };
    let found = device.image(drawn, &sheet.params(), &camera, &settings, [0.0; 3]);
    found.unwrap()
}

#[test]
fn an_image_that_the_device_cannot_draw_is_left_to_the_cpu() {
    let Some(device) = device(Options::default()) else {
        return;
    };
    let (sheet, plain) = (Sheet::new(300), Settings::default());
    let mut drawn = Drawn::default();
    let convention = Convention::Inria;
    let inria = Settings {
        convention,
        ..plain
    };
    assert!(image(&device, &mut drawn, &sheet, inria).is_none());
    let first = image(&device, &mut drawn, &sheet, plain).unwrap();
    assert!(first.iter().any(|v| *v > 0.0));
    assert!(image(&device, &mut drawn, &sheet, plain).unwrap() == first);
    assert_eq!((device.served(), device.notes()), (1, Vec::new()));
    if let Drawn::Scene(scene) = &mut drawn {
        scene.fork();
    }
    assert!(image(&device, &mut drawn, &sheet, plain).is_none());
    let notes = device.notes();
    assert!(notes.len() == 1 && notes[0].contains("spawn"), "{notes:?}");
    assert!(image(&device, &mut Drawn::default(), &sheet, plain).is_none());
    assert!(device.notes().is_empty());
}

#[test]
fn a_scene_too_large_to_draw_leaves_smaller_ones_to_the_device() {
    let max_binding = Some(1 << 17);
    let options = Options {
        max_binding,
        ..Options::default()
    };
    let Some(device) = device(options) else {
        return;
    };
    let (large, small) = (Sheet::new(3000), Sheet::new(1));
    for notes in [1, 0] {
        let mut drawn = Drawn::default();
        assert!(image(&device, &mut drawn, &large, Settings::default()).is_none());
        assert_eq!(device.notes().len(), notes);
        assert!(image(&device, &mut drawn, &large, Settings::default()).is_none());
        assert!(device.notes().is_empty());
    }
    let mut drawn = Drawn::default();
    assert!(image(&device, &mut drawn, &small, Settings::default()).is_some());
    device.gpu().expect("an open device").lose();
    for notes in [1, 0] {
        assert!(image(&device, &mut drawn, &small, Settings::default()).is_none());
        assert_eq!(device.notes().len(), notes);
        drawn = Drawn::default();
    }
}

#[test]
fn few_images_and_software_are_the_cpus() {
    let sheet = Sheet::new(10);
    for choice in [Choice::Cpu, Choice::Auto] {
        let device = Device::new(choice, Options::default());
        let mut drawn = Drawn::default();
        for _ in 0..2 * WORTH_DRAWING {
            assert!(image(&device, &mut drawn, &sheet, Settings::default()).is_none());
        }
        assert_eq!((device.served(), device.notes()), (0, Vec::new()));
    }
    let device = Device::new(Choice::Auto, Options::default());
    assert!(device.draws(WORTH_TRAINING, WORTH_DRAWING - 1).is_none());
    assert!(matches!(*lock(&device.training), State::Untried));
    let _ = device.draws(WORTH_TRAINING, WORTH_DRAWING);
    assert!(!matches!(*lock(&device.training), State::Untried));
}
