//! An open device: its buffers, pipelines and health.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use wgpu::{BufferDescriptor, BufferUsages, ComputePipeline, ComputePipelineDescriptor};

use super::adapters::{self, Adapter};
use super::room::{RESERVE, Room, to_open};
use super::{Error, Result};

/// Options for opening a device; the default uses the adapter's own limits.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Largest binding in bytes, below the adapter's limit.
    pub max_binding: Option<u64>,
    /// Measure the time of every kernel, if the adapter can.
    pub timed: bool,
}

/// Source that precedes every kernel.
const DISPATCH: &str = include_str!("dispatch.wgsl");

/// One entry point of a shader. Its sources follow dispatch.wgsl in order.
#[derive(Debug, Clone, Copy)]
pub struct Kernel {
    pub name: &'static str,
    pub sources: &'static [&'static str],
    pub entry: &'static str,
}

impl Kernel {
    pub const fn new(
        name: &'static str,
        sources: &'static [&'static str],
        entry: &'static str,
    ) -> Self {
        Self {
            name,
            sources,
            entry,
        }
    }
}

/// A buffer of words on the device.
#[derive(Debug, Clone)]
pub struct Buffer {
    pub(super) inner: wgpu::Buffer,
    words: usize,
}

impl Buffer {
    pub fn words(&self) -> usize {
        self.words
    }
}

/// A buffer with the constants of a dispatch.
#[derive(Debug, Clone)]
pub struct Constants(pub(super) wgpu::Buffer);

/// The first error since the last check.
type Health = Arc<Mutex<Option<Error>>>;

#[derive(Debug)]
pub struct Gpu {
    pub adapter: Adapter,
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pipelines: Mutex<HashMap<&'static str, ComputePipeline>>,
    health: Health,
    room: Room,
    max_binding: u64,
    pub(super) timed: bool,
    timings: Mutex<BTreeMap<&'static str, f64>>,
    /// Bytes sent so far.
    sent: AtomicU64,
}

impl Gpu {
    /// Open the best adapter; software adapters only if `software` is set.
    pub fn open(software: bool, options: Options) -> Result<Self> {
        let room = Room::of_process();
        room.check(to_open())?;
        let (adapter, inner) = adapters::found()
            .into_iter()
            .find(|(adapter, _)| software || !adapter.is_software())
            .ok_or(Error::NoAdapter)?;
        let request = inner.request_device(&wgpu::DeviceDescriptor {
            label: Some("g2ard"),
            required_features: inner.features() & wgpu::Features::TIMESTAMP_QUERY,
            required_limits: inner.limits(),
            ..Default::default()
        });
        let (device, queue) = pollster::block_on(request).map_err(|e| Error::NoDevice {
            name: adapter.name.clone(),
            why: one_line(&e.to_string()),
        })?;
        let health = Health::default();
        watch(&device, &health);
        let offered = adapter.max_binding.min(adapter.max_buffer) & !255;
        Ok(Self {
            max_binding: options.max_binding.map_or(offered, |m| m.min(offered)),
            timed: options.timed && adapter.timestamps,
            adapter,
            device,
            queue,
            pipelines: Mutex::default(),
            health,
            room,
            timings: Mutex::default(),
            sent: AtomicU64::new(0),
        })
    }

    /// Most words that one buffer can hold.
    pub fn max_words(&self) -> usize {
        usize::try_from(self.max_binding / 4).unwrap_or(usize::MAX)
    }

    /// Most loop iterations per thread, over all its loops. Mesa's llvmpipe silently ends them at 65,535.
    pub fn max_rounds(&self) -> usize {
        if self.adapter.is_software() {
            48_000
        } else {
            usize::MAX
        }
    }

    /// Return the first error since the last check.
    pub fn check(&self) -> Result<()> {
        if lock(&self.health).is_none() {
            return Ok(());
        }
        // Operations on a lost device only report invalid objects; polling reports the loss itself.
        let _ = self.device.poll(wgpu::PollType::Poll);
        lock(&self.health).take().map_or(Ok(()), Err)
    }

    /// A buffer of zeros, with at least one word because empty buffers cannot be bound.
    pub fn buffer(&self, what: &'static str, words: usize) -> Result<Buffer> {
        let bytes = 4 * words.max(1) as u64;
        if bytes > self.max_binding {
            return Err(Error::TooLarge {
                what,
                bytes,
                limit: self.max_binding,
            });
        }
        self.room.check(bytes + RESERVE)?;
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        let inner = self.create(what, bytes, usage);
        self.check()?;
        Ok(Buffer { inner, words })
    }

    /// A buffer that holds `data`.
    pub fn upload<T: bytemuck::NoUninit>(&self, what: &'static str, data: &[T]) -> Result<Buffer> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let buffer = self.buffer(what, bytes.len() / 4)?;
        self.write(&buffer.inner, 0, bytes);
        self.check()?;
        Ok(buffer)
    }

    /// A uniform buffer with the constants of a dispatch.
    pub fn constants(&self, values: &[u32]) -> Constants {
        let bytes = 4 * values.len().next_multiple_of(4) as u64;
        let usage = BufferUsages::UNIFORM | BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = Constants(self.create("constants", bytes, usage));
        self.set_constants(&buffer, values);
        buffer
    }

    /// Change constants before work that is submitted from now on.
    pub fn set_constants(&self, constants: &Constants, values: &[u32]) {
        self.write(&constants.0, 0, bytemuck::cast_slice(values));
    }

    /// Write the first words of a buffer before work that is submitted from now on.
    pub fn overwrite<T: bytemuck::NoUninit>(&self, buffer: &Buffer, data: &[T]) {
        self.overwrite_at(buffer, 0, data);
    }

    /// Write words of a buffer from the `first` one on, before work that is submitted from now on.
    pub fn overwrite_at<T: bytemuck::NoUninit>(&self, buffer: &Buffer, first: usize, data: &[T]) {
        self.write(&buffer.inner, 4 * first as u64, bytemuck::cast_slice(data));
    }

    pub(super) fn create(&self, label: &str, size: u64, usage: BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&BufferDescriptor {
            label: Some(label),
            size,
            usage,
            mapped_at_creation: false,
        })
    }

    fn write(&self, buffer: &wgpu::Buffer, at: u64, bytes: &[u8]) {
        self.queue.write_buffer(buffer, at, bytes);
        self.sent.fetch_add(bytes.len() as u64, Ordering::Relaxed);
    }

    /// Bytes sent to the device so far.
    pub fn sent(&self) -> u64 {
        self.sent.load(Ordering::Relaxed)
    }

    /// The pipeline of a kernel, compiled on first use.
    pub(super) fn pipeline(&self, kernel: &Kernel) -> Result<ComputePipeline> {
        let mut pipelines = lock(&self.pipelines);
        if let Some(pipeline) = pipelines.get(kernel.name) {
            return Ok(pipeline.clone());
        }
        self.room.check(RESERVE)?;
        let mut source = DISPATCH.to_owned() + &kernel.sources.concat();
        if self.adapter.is_software() {
            // Mesa's lavapipe clones a shader for each dispatch to insert uniforms of its branches, and keeps the clones.
            source = source.replace("var<uniform>", "var<storage, read>");
        }
        let module = self
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(kernel.name),
                source: wgpu::ShaderSource::Wgsl(source.into()),
            });
        self.check()?;
        let pipeline = self
            .device
            .create_compute_pipeline(&ComputePipelineDescriptor {
                label: Some(kernel.name),
                layout: None,
                module: &module,
                entry_point: Some(kernel.entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    // Kernels write all workgroup memory before they read it.
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            });
        self.check()?;
        pipelines.insert(kernel.name, pipeline.clone());
        Ok(pipeline)
    }

    /// Lose the device, as after a driver's reset.
    #[cfg(test)]
    pub fn lose(&self) {
        self.device.destroy();
    }

    /// Seconds on the device per kernel, if they are measured.
    pub fn timings(&self) -> BTreeMap<&'static str, f64> {
        lock(&self.timings).clone()
    }

    pub(super) fn took(&self, kernel: &'static str, seconds: f64) {
        *lock(&self.timings).entry(kernel).or_default() += seconds;
    }
}

/// Collect errors for `check` instead of panicking.
fn watch(device: &wgpu::Device, health: &Health) {
    let seen = health.clone();
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
        let error = match error {
            wgpu::Error::OutOfMemory { .. } => Error::OutOfMemory,
            other => Error::Refused(one_line(&other.to_string())),
        };
        lock(&seen).get_or_insert(error);
    }));
    let seen = health.clone();
    device.set_device_lost_callback(move |reason, message| {
        let text = format!("{reason:?} {message}").to_lowercase();
        *lock(&seen) = Some(Error::Lost(one_line(&text)));
    });
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Lock a mutex. Poisoning is ignored: no code panics while it holds one, and its data is always consistent.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
