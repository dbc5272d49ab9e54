//! Recorded dispatches, and results to read when they are done.

use std::iter;
use std::time::Duration;

use wgpu::{
    BindGroupDescriptor, BindGroupEntry, BufferUsages, CommandEncoder, ComputePassDescriptor,
    ComputePassTimestampWrites, MapMode, PollType, QuerySet, QuerySetDescriptor, QueryType,
};

use super::gpu::{Buffer, Gpu, Kernel};
use super::{Error, Result};

/// Most workgroups along one axis of a dispatch that WebGPU guarantees.
const MAX_GROUPS: usize = 65_535;

/// Most kernels of one submission that are timed.
const MAX_TIMED: usize = 2048;

/// Seconds after which a driver that does not answer is considered hung.
const PATIENCE: u64 = 120;

/// Recorded work; nothing runs before `submit`.
pub struct Work<'a> {
    gpu: &'a Gpu,
    encoder: CommandEncoder,
    clock: Option<Clock>,
}

/// Start and end of each kernel.
struct Clock {
    ticks: QuerySet,
    kernels: Vec<&'static str>,
}

/// Results that are not read yet.
pub struct Pending<'a> {
    gpu: &'a Gpu,
    index: wgpu::SubmissionIndex,
    reads: Vec<wgpu::Buffer>,
    /// Kernels whose ticks form the last read.
    timed: Option<Vec<&'static str>>,
}

impl<'a> Work<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu.device.create_command_encoder(&Default::default());
        let clock = gpu.timed.then(|| Clock {
            ticks: gpu.device.create_query_set(&QuerySetDescriptor {
                label: Some("ticks"),
                ty: QueryType::Timestamp,
                count: 2 * MAX_TIMED as u32,
            }),
            kernels: Vec::new(),
        });
        Self {
            gpu,
            encoder,
            clock,
        }
    }

    /// Run a kernel in `groups` workgroups. Binding 0 holds `constants`; `buffers` follow.
    ///
    /// Workgroups beyond one row of the dispatch continue in the next; kernels count y·(groups along x) + x.
    pub fn run(
        &mut self,
        kernel: &Kernel,
        groups: usize,
        constants: &[u32],
        buffers: &[&Buffer],
    ) -> Result<()> {
        let bound: Vec<_> = (1..).zip(buffers.iter().copied()).collect();
        self.run_at(kernel, groups, constants, &bound)
    }

    /// Run a kernel with explicit binding numbers, for kernels that do not use every binding of their file.
    pub fn run_at(
        &mut self,
        kernel: &Kernel,
        groups: usize,
        constants: &[u32],
        buffers: &[(u32, &Buffer)],
    ) -> Result<()> {
        if groups == 0 {
            return Ok(());
        }
        let pipeline = self.gpu.pipeline(kernel)?;
        let constants = self.gpu.constants(constants);
        let rest = buffers.iter().map(|(at, buffer)| (*at, &buffer.inner));
        let entries: Vec<_> = iter::once((0, &constants))
            .chain(rest)
            .map(|(binding, buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let group = self.gpu.device.create_bind_group(&BindGroupDescriptor {
            label: Some(kernel.name),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries,
        });
        let mut pass = self.encoder.begin_compute_pass(&ComputePassDescriptor {
            label: Some(kernel.name),
            timestamp_writes: self.clock.as_mut().and_then(|c| c.next(kernel.name)),
        });
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        let rows = groups.div_ceil(MAX_GROUPS);
        pass.dispatch_workgroups(groups.div_ceil(rows) as u32, rows as u32, 1);
        Ok(())
    }

    /// Fill a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.encoder.clear_buffer(&buffer.inner, 0, None);
    }

    /// Submit the work. Each of `reads` is a buffer and the number of its first words to read when the work is done.
    pub fn submit(mut self, reads: &[(&Buffer, usize)]) -> Result<Pending<'a>> {
        let mut reads: Vec<_> = reads
            .iter()
            .map(|(buffer, words)| self.readback(&buffer.inner, 4 * (*words).max(1) as u64))
            .collect();
        let timed = self.clock.take().filter(|c| !c.kernels.is_empty());
        let timed = timed.map(|clock| {
            let count = 2 * clock.kernels.len() as u32;
            let (size, usage) = (8 * u64::from(count), BufferUsages::QUERY_RESOLVE);
            let ticks = self
                .gpu
                .create("ticks", size, usage | BufferUsages::COPY_SRC);
            self.encoder
                .resolve_query_set(&clock.ticks, 0..count, &ticks, 0);
            reads.push(self.readback(&ticks, size));
            clock.kernels
        });
        let index = self.gpu.queue.submit([self.encoder.finish()]);
        self.gpu.check()?;
        for copy in &reads {
            copy.map_async(MapMode::Read, .., |_| {}); // `take` sees whether it succeeded
        }
        Ok(Pending {
            gpu: self.gpu,
            index,
            reads,
            timed,
        })
    }

    /// A copy of a buffer that the CPU can map.
    fn readback(&mut self, from: &wgpu::Buffer, size: u64) -> wgpu::Buffer {
        let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let copy = self.gpu.create("readback", size, usage);
        self.encoder.copy_buffer_to_buffer(from, 0, &copy, 0, size);
        copy
    }
}

impl Clock {
    fn next(&mut self, kernel: &'static str) -> Option<ComputePassTimestampWrites<'_>> {
        let at = 2 * self.kernels.len() as u32;
        if self.kernels.len() == MAX_TIMED {
            return None;
        }
        self.kernels.push(kernel);
        Some(ComputePassTimestampWrites {
            query_set: &self.ticks,
            beginning_of_pass_write_index: Some(at),
            end_of_pass_write_index: Some(at + 1),
        })
    }
}

impl Pending<'_> {
    /// Wait for the results; return the words of each read.
    pub fn take(self) -> Result<Vec<Vec<u32>>> {
        let waited = self.gpu.device.poll(PollType::Wait {
            submission_index: Some(self.index),
            timeout: Some(Duration::from_secs(PATIENCE)),
        });
        self.gpu.check()?;
        if waited.is_err() {
            return Err(Error::Timeout(PATIENCE));
        }
        let words = self.reads.iter().map(|copy| {
            let lost = |_| Error::Lost("its memory could not be read".to_owned());
            let view = copy.get_mapped_range(..).map_err(lost)?;
            Ok(bytemuck::pod_collect_to_vec::<u8, u32>(&view[..]))
        });
        let mut words = words.collect::<Result<Vec<_>>>()?;
        if let Some((kernels, ticks)) = self.timed.as_ref().and_then(|k| Some((k, words.pop()?))) {
            let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&ticks);
            let period = 1e-9 * f64::from(self.gpu.queue.get_timestamp_period());
            for (kernel, span) in kernels.iter().zip(ticks.chunks(2)) {
                let spent = span[1].saturating_sub(span[0]);
                self.gpu.took(kernel, spent as f64 * period);
            }
        }
        Ok(words)
    }
}
