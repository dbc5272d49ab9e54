//! The backend that callers use: GPU kernels while they work, then the CPU, with the reasons.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use g2ard_core::raster::{Camera, Settings};
use g2ard_core::select::{Gaussians, Surface, ViewKernels};
use g2ard_core::simplify::{Group, GroupKernels, Merged};
use g2ard_core::spatial::{Cells, RobustBounds};
use g2ard_core::visibility::{VisibilityAccumulator, VisibilityKernels};
use g2ard_core::{Backend, Control, Cpu, Result, Splats};

use crate::rows::{Numbered, Numbers, Rows};
use crate::runtime::{Adapter, Error, Gpu, Options, guarded};
use crate::two::Frame;
use crate::{groups, probe, visibility, voxels};

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

/// Smallest number of rows for which opening a device pays.
const WORTH_OPENING: usize = 200_000;

/// A backend that runs GPU kernels. After a device fails, it uses the CPU and does not retry.
#[derive(Debug, Default)]
pub struct Device {
    choice: Choice,
    options: Options,
    state: Mutex<State>,
    notes: Mutex<Vec<String>>,
    /// Kernels that ran on the GPU.
    served: AtomicU64,
}

#[derive(Debug, Clone, Default)]
enum State {
    #[default]
    Untried,
    Open(Arc<Gpu>),
    Off,
}

impl Device {
    pub fn new(choice: Choice, options: Options) -> Self {
        Self {
            choice,
            options,
            ..Self::default()
        }
    }

    /// The adapter in use; None before the first kernel and on the CPU.
    pub fn adapter(&self) -> Option<Adapter> {
        match &*lock(&self.state) {
            State::Open(gpu) => Some(gpu.adapter.clone()),
            _ => None,
        }
    }

    /// Messages for the user since the last call.
    pub fn notes(&self) -> Vec<String> {
        std::mem::take(&mut *lock(&self.notes))
    }

    /// Number of kernels that ran on the GPU.
    pub fn served(&self) -> u64 {
        self.served.load(Ordering::Relaxed)
    }

    /// The open device, if any.
    pub fn gpu(&self) -> Option<Arc<Gpu>> {
        match &*lock(&self.state) {
            State::Open(gpu) => Some(gpu.clone()),
            _ => None,
        }
    }

    /// The device for work on `rows` rows; opened on first use if the work is large enough.
    fn ready(&self, rows: usize) -> Option<Arc<Gpu>> {
        let mut state = lock(&self.state);
        match &*state {
            State::Open(gpu) => return Some(gpu.clone()),
            State::Off => return None,
            State::Untried => {}
        }
        let found = match self.choice {
            Choice::Cpu => return None,
            Choice::Auto if rows < WORTH_OPENING => return None,
            Choice::Auto => self.worthwhile(),
            Choice::Gpu => guarded(|| {
                let gpu = Gpu::open(true, self.options)?;
                probe::check(&gpu)?;
                Ok(gpu)
            })
            .map(Some),
        };
        match found {
            Ok(Some(gpu)) => {
                let gpu = Arc::new(gpu);
                *state = State::Open(gpu.clone());
                Some(gpu)
            }
            Ok(None) => {
                *state = State::Off;
                None
            }
            Err(error) => {
                *state = State::Off;
                self.note(&error);
                None
            }
        }
    }

    /// A real GPU that is faster than the CPU. A missing GPU, or too little memory for one, is not reported.
    fn worthwhile(&self) -> crate::runtime::Result<Option<Gpu>> {
        guarded(|| match Gpu::open(false, self.options) {
            Ok(gpu) => Ok(probe::pays(&gpu)?.then_some(gpu)),
            Err(Error::NoAdapter | Error::NoRoom { .. }) => Ok(None),
            Err(other) => Err(other),
        })
    }

    fn note(&self, error: &Error) {
        let line = format!("GPU: {error}; goes on on the CPU");
        let mut notes = lock(&self.notes);
        if !notes.contains(&line) {
            notes.push(line);
        }
    }

    /// Run `twin` on the device; None if the CPU must answer.
    fn attempt<T>(
        &self,
        rows: usize,
        twin: impl FnOnce(&Gpu) -> crate::runtime::Result<T>,
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
        twin: impl FnOnce(&Gpu) -> crate::runtime::Result<T>,
        cpu: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        match self.attempt(rows, twin)? {
            Some(found) => Ok(found),
            None => cpu(),
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ViewKernels for Device {
    fn cells(&self, points: &[[f64; 3]], bounds: &RobustBounds, target: usize) -> Result<Cells> {
        self.either(
            points.len(),
            |gpu| voxels::adaptive(gpu, points, bounds, target),
            || ViewKernels::cells(&Cpu, points, bounds, target),
        )
    }

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
        if visibility::serves(settings) && !sums.is_empty() {
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

impl Backend for Device {
    fn group_kernels(&self) -> Box<dyn GroupKernels + '_> {
        Box::new(RunOnDevice {
            device: self,
            uploaded: Mutex::default(),
            numbers: Mutex::default(),
        })
    }
}

/// One run of simplification, and the rows that the device holds for it.
struct RunOnDevice<'a> {
    device: &'a Device,
    uploaded: Mutex<Rows>,
    numbers: Mutex<Numbers>,
}

impl RunOnDevice<'_> {
    /// Upload the missing rows and run `twin` on the device, or `cpu` as a fallback.
    fn either<T>(
        &self,
        splats: &Splats,
        twin: impl FnOnce(&Gpu, &Rows, Frame, Numbered<'_>) -> crate::runtime::Result<T>,
        cpu: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let mut numbers = lock(&self.numbers);
        let rows = Numbered {
            splats,
            numbers: numbers.of(splats.len()),
        };
        let with_rows = |gpu: &Gpu| {
            let mut uploaded = lock(&self.uploaded);
            let frame = uploaded.follow(gpu, rows)?;
            twin(gpu, &uploaded, frame, rows)
        };
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
            |gpu, uploaded, frame, rows| voxels::of_rows(gpu, uploaded, frame, rows, kept, target),
            || GroupKernels::cells(&Cpu, splats, kept, target),
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
            |gpu, uploaded, _, rows| groups::energies(gpu, uploaded, rows, count, group, control),
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
            |gpu, uploaded, frame, rows| {
                groups::merges(gpu, uploaded, frame, rows, groups, support, control)
            },
            || Cpu.merges(splats, groups, support, control),
        )
    }

    fn rows_replaced(&self, copied: &[u32]) {
        lock(&self.numbers).replace(copied);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::no_adapter;

    fn open() -> Option<Device> {
        let device = Device::new(Choice::Gpu, Options::default());
        if device.ready(1).is_none() {
            no_adapter("failures");
            return None;
        }
        Some(device)
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
            let Some(device) = open() else { return };
            let why = failure.to_string();
            let twin = |_: &Gpu| -> crate::runtime::Result<u8> { Err(failure) };
            assert_eq!(device.either(1, twin, || Ok(7)).unwrap(), 7);
            assert_eq!(device.notes(), [format!("GPU: {why}; goes on on the CPU")]);
            assert!(device.gpu().is_none(), "left for good");
            assert_eq!(device.served(), 0);
        }
    }

    #[test]
    fn what_is_too_large_for_one_kernel_is_no_reason_to_leave() {
        let (what, limit) = ("rows", 3);
        let large = Error::TooLarge {
            what,
            bytes: 4,
            limit,
        };
        let many = Error::TooMany {
            what,
            count: 4,
            limit,
        };
        let told = "4 rows are too many for the device, which takes 3 at most";
        assert_eq!(many.to_string(), told);
        for failure in [large, many] {
            let Some(device) = open() else { return };
            let twin = |_: &Gpu| -> crate::runtime::Result<u8> { Err(failure) };
            assert_eq!(device.either(1, twin, || Ok(7)).unwrap(), 7);
            assert_eq!(device.notes().len(), 1);
            assert_eq!(device.either(1, |_| Ok(8), || Ok(7)).unwrap(), 8);
        }
    }

    #[test]
    fn a_stop_is_no_failure() {
        let Some(device) = open() else { return };
        let twin = |_: &Gpu| -> crate::runtime::Result<u8> { Err(Error::Interrupted) };
        let found = device.either(1, twin, || Ok(7));
        assert_eq!(found.unwrap_err(), g2ard_core::Error::Interrupted);
        assert!(device.notes().is_empty());
    }
}
