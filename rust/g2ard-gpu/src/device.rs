//! The backend that callers use: GPU kernels while they work, then the CPU, with the reasons.

use std::collections::HashSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use g2ard_core::raster::visibility::{VisibilityAccumulator, VisibilityKernels};
use g2ard_core::raster::{Camera, Convention, Params, Settings};
use g2ard_core::select::{Gaussians, Surface, ViewKernels};
use g2ard_core::simplify::{Group, GroupKernels, Merged};
use g2ard_core::spatial::Cells;
use g2ard_core::train::{Store, Train, TrainKernels};
use g2ard_core::{Backend, Control, Cpu, Result, Splats};

use crate::rows::{Rows, Run};
use crate::runtime::{self, Error, Gpu, Options, Owned, guarded, lock};
use crate::{groups, probe, train, visibility, voxels};

#[cfg(test)]
mod tests;

/// The device to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Choice {
    #[default]
    Cpu,
    /// The best adapter, software ones too.
    Gpu,
    /// A real GPU, for large scenes, if it is faster than the CPU on a probe.
    Auto,
}

/// Smallest number of rows for which opening a device pays, for one pass over them and for training.
const WORTH_OPENING: usize = 200_000;
const WORTH_TRAINING: usize = 10_000;

/// Number of images of one scene before opening a device pays.
const WORTH_DRAWING: usize = 8;

/// A backend that runs GPU kernels. After a device fails, it uses the CPU and does not retry.
#[derive(Debug, Default)]
pub struct Device {
    choice: Choice,
    options: Options,
    state: Mutex<State>,
    /// The state for training and images, which may pay where single kernels do not, and fail alone.
    training: Mutex<State>,
    notes: Mutex<Notes>,
    /// Kernels that ran on the GPU.
    served: AtomicU64,
}

/// Messages for the user: those to tell, and all so far, because smaller scenes try a device again.
#[derive(Debug, Default)]
struct Notes {
    pending: Vec<String>,
    all: HashSet<String>,
}

#[derive(Debug, Default)]
enum State {
    #[default]
    Untried,
    Open(Owned<Arc<Gpu>>),
    Off,
}

impl State {
    fn gpu(&self) -> Option<Arc<Gpu>> {
        match self {
            Self::Open(opened) => opened.get().ok().cloned(),
            _ => None,
        }
    }
}

/// What a device keeps of a scene between two images of it.
pub enum Drawn {
    /// Nothing yet; the number of images that the CPU has drawn.
    Nothing(usize),
    Scene(Box<train::Images>),
    /// Nothing ever, because the device has failed.
    Never,
}

impl Default for Drawn {
    fn default() -> Self {
        Self::Nothing(0)
    }
}

impl Device {
    pub fn new(choice: Choice, options: Options) -> Self {
        Self {
            choice,
            options,
            ..Self::default()
        }
    }

    /// Messages for the user since the last call.
    pub fn notes(&self) -> Vec<String> {
        std::mem::take(&mut lock(&self.notes).pending)
    }

    /// Number of kernels that ran on the GPU.
    pub fn served(&self) -> u64 {
        self.served.load(Ordering::Relaxed)
    }

    /// The open device; None before the first kernel and on the CPU.
    pub fn gpu(&self) -> Option<Arc<Gpu>> {
        let kernels = lock(&self.state).gpu();
        kernels.or_else(|| lock(&self.training).gpu())
    }

    /// The device for work on `rows` rows; opened on first use if the work is large enough.
    fn ready(&self, rows: usize) -> Option<Arc<Gpu>> {
        let mut state = lock(&self.state);
        if matches!(&*state, State::Open(opened) if opened.inherited()) {
            self.note(&Error::Forked);
            *state = State::Off;
        }
        if matches!(*state, State::Untried) {
            let opened = match self.choice {
                Choice::Cpu => return None,
                Choice::Auto if rows < WORTH_OPENING => return None,
                Choice::Auto => guarded(|| self.worthwhile()),
                Choice::Gpu => guarded(|| {
                    let gpu = Gpu::open(true, self.options)?;
                    probe::check(&gpu)?;
                    Ok(Some(gpu))
                }),
            };
            *state = match opened {
                Ok(Some(gpu)) => State::Open(Owned::new(Arc::new(gpu))),
                Ok(None) => State::Off,
                Err(error) => {
                    self.note(&error);
                    State::Off
                }
            };
        }
        state.gpu()
    }

    /// A real GPU that is faster than the CPU. A missing GPU, or too little memory for one, is not reported.
    fn worthwhile(&self) -> runtime::Result<Option<Gpu>> {
        match Gpu::open(false, self.options) {
            Ok(gpu) => Ok(probe::pays(&gpu)?.then_some(gpu)),
            Err(Error::NoAdapter | Error::NoRoom { .. }) => Ok(None),
            Err(other) => Err(other),
        }
    }

    /// The device for training or drawing `rows` rows.
    fn trains(&self, rows: usize) -> Option<Arc<Gpu>> {
        let mut state = lock(&self.training);
        if matches!(&*state, State::Open(opened) if opened.inherited()) {
            self.note(&Error::Forked);
            *state = State::Off;
        }
        if matches!(*state, State::Untried) {
            let gpu = match self.choice {
                Choice::Cpu => return None,
                Choice::Auto if rows < WORTH_TRAINING => return None,
                Choice::Auto => guarded(|| self.worth_training()).unwrap_or_else(|error| {
                    self.note(&error);
                    None
                }),
                Choice::Gpu => self.ready(rows),
            };
            *state = gpu.map_or(State::Off, |gpu| State::Open(Owned::new(gpu)));
        }
        state.gpu()
    }

    /// A real GPU that trains faster than the CPU.
    fn worth_training(&self) -> runtime::Result<Option<Arc<Gpu>>> {
        let opened = lock(&self.state).gpu();
        let gpu = match opened {
            Some(gpu) => gpu,
            None => match Gpu::open(false, self.options) {
                Ok(gpu) => Arc::new(gpu),
                Err(Error::NoAdapter | Error::NoRoom { .. }) => return Ok(None),
                Err(other) => return Err(other),
            },
        };
        Ok(probe::training_pays(&gpu)?.then_some(gpu))
    }

    /// Draw an image of a scene: always the same one with the same `drawn`. None if the CPU must draw.
    pub fn image(
        &self,
        drawn: &mut Drawn,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
    ) -> Result<Option<Vec<f32>>> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        if self.choice == Choice::Cpu || settings.convention != Convention::Gsplat {
            return Ok(None);
        }
        let found = match drawn {
            Drawn::Never => return Ok(None),
            Drawn::Scene(scene) => scene.draw(camera, settings, background),
            Drawn::Nothing(earlier) => {
                let Some(gpu) = self.draws(params.len(), *earlier) else {
                    *earlier += 1;
                    return Ok(None);
                };
                train::Images::new(gpu, params).and_then(|mut scene| {
                    let image = scene.draw(camera, settings, background)?;
                    self.served.fetch_add(1, Ordering::Relaxed);
                    *drawn = Drawn::Scene(Box::new(scene));
                    Ok(image)
                })
            }
        };
        Ok(found
            .inspect_err(|error| {
                *drawn = Drawn::Never;
                match error {
                    // Smaller scenes may fit.
                    Error::OutOfMemory | Error::NoRoom { .. } => self.note(error),
                    _ if error.is_of_size() => self.note(error),
                    _ => self.stop_training(&error.to_string()),
                }
            })
            .ok())
    }

    /// The device for images of a scene of `rows` rows, of which the CPU drew `earlier` ones.
    fn draws(&self, rows: usize, earlier: usize) -> Option<Arc<Gpu>> {
        let untried = matches!(*lock(&self.training), State::Untried);
        if self.choice == Choice::Auto && untried && earlier < WORTH_DRAWING {
            return None;
        }
        self.trains(rows)
    }

    /// Train and draw on the CPU from now on, because the device failed.
    pub fn stop_training(&self, why: &str) {
        self.note(&why);
        *lock(&self.training) = State::Off;
    }

    fn note(&self, error: &impl std::fmt::Display) {
        let line = format!("GPU: {error}; goes on on the CPU");
        let mut notes = lock(&self.notes);
        if notes.all.insert(line.clone()) {
            notes.pending.push(line);
        }
    }

    /// Run `twin` on the device; None if the CPU must answer.
    fn attempt<T>(
        &self,
        rows: usize,
        twin: impl FnOnce(&Gpu) -> runtime::Result<T>,
    ) -> Result<Option<T>> {
        let Some(gpu) = self.ready(rows) else {
            return Ok(None);
        };
        match guarded(|| twin(&gpu)) {
            Ok(found) => {
                self.served.fetch_add(1, Ordering::Relaxed);
                Ok(Some(found))
            }
            Err(Error::Interrupted) => Err(g2ard_core::Error::Interrupted),
            Err(error) => {
                self.note(&error);
                if !error.is_of_size() {
                    *lock(&self.state) = State::Off;
                }
                Ok(None)
            }
        }
    }

    /// Run `twin` on the device, or `cpu` as a fallback.
    fn either<T>(
        &self,
        rows: usize,
        twin: impl FnOnce(&Gpu) -> runtime::Result<T>,
        cpu: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        match self.attempt(rows, twin)? {
            Some(found) => Ok(found),
            None => cpu(),
        }
    }
}

impl ViewKernels for Device {
    fn view_statistics(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>> {
        self.either(
            scene.means.len(),
            |gpu| visibility::view_statistics(gpu, scene, cameras, control),
            || Cpu.view_statistics(scene, cameras, control),
        )
    }

    fn visible_cells(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        tolerance: f32,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>> {
        self.either(
            scene.means.len(),
            |gpu| visibility::visible_cells(gpu, scene, surface, tolerance, cameras, control),
            || Cpu.visible_cells(scene, surface, tolerance, cameras, control),
        )
    }
}

impl VisibilityKernels for Device {
    fn add_views(
        &self,
        sums: &mut VisibilityAccumulator,
        cameras: &[Camera],
        settings: &Settings,
        control: &Control,
    ) -> Result<()> {
        for camera in cameras {
            camera.validate()?;
        }
        settings.validate()?;
        if visibility::serves(settings) && sums.len() > 0 {
            let count = sums.len();
            let twin = |gpu: &Gpu| visibility::weights(gpu, sums, cameras, settings, control);
            if let Some(weights) = self.attempt(count, twin)? {
                sums.add_sums(cameras, &weights);
                return Ok(());
            }
        }
        Cpu.add_views(sums, cameras, settings, control)
    }
}

impl TrainKernels for Device {
    fn trainer(&self, params: &Params, units: Option<&[f32]>) -> Result<Box<dyn Train>> {
        params.validate()?;
        let Some(gpu) = self.trains(params.len()) else {
            return Cpu.trainer(params, units);
        };
        let start = Store::new(params, units)?.export();
        match guarded(|| train::Trainer::new(gpu, &start, params.sh_coeffs)) {
            Ok(trainer) => {
                self.served.fetch_add(1, Ordering::Relaxed);
                Ok(Box::new(trainer))
            }
            Err(error) => {
                self.stop_training(&error.to_string());
                Cpu.trainer(params, units)
            }
        }
    }
}

impl Backend for Device {
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_> {
        Box::new(RunOnDevice {
            device: self,
            uploaded: Mutex::default(),
        })
    }
}

/// One run of simplification, and the rows that the device holds for it.
struct RunOnDevice<'a> {
    device: &'a Device,
    uploaded: Mutex<Rows>,
}

impl RunOnDevice<'_> {
    /// Upload the missing rows and run `twin` on the device, or `cpu` as a fallback.
    fn either<T>(
        &self,
        splats: &Splats,
        twin: impl FnOnce(Run<'_>) -> runtime::Result<T>,
        cpu: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let with_rows = |gpu: &Gpu| twin(lock(&self.uploaded).of(gpu, splats)?);
        let without = || {
            if self.device.gpu().is_none() {
                *lock(&self.uploaded) = Rows::default(); // a failed device is not retried
            }
            cpu()
        };
        self.device.either(splats.len(), with_rows, without)
    }
}

impl GroupKernels for RunOnDevice<'_> {
    fn cells(&self, splats: &Splats, kept: &[u32], target: usize) -> Result<Cells> {
        self.either(
            splats,
            |run| voxels::adaptive(run, kept, target),
            || Cpu.cells(splats, kept, target),
        )
    }

    fn energies(
        &self,
        splats: &Splats,
        count: usize,
        group: &Group<'_>,
        control: &Control,
    ) -> Result<Vec<f64>> {
        self.either(
            splats,
            |run| groups::energies(run, count, group, control),
            || Cpu.energies(splats, count, group, control),
        )
    }

    fn merges(
        &self,
        splats: &Splats,
        groups: &[&[u32]],
        support: f64,
        control: &Control,
    ) -> Result<Vec<(Merged, f64)>> {
        self.either(
            splats,
            |run| groups::merges(run, groups, support, control),
            || Cpu.merges(splats, groups, support, control),
        )
    }

    fn rows_replaced(&self) {
        lock(&self.uploaded).clear();
    }
}
