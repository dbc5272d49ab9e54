//! Dispatches in order, and what they leave to be read.

use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use wgpu::{
    BindGroupDescriptor, BindGroupEntry, BufferDescriptor, BufferUsages, CommandEncoder,
    ComputePassDescriptor, MapMode, PollType,
};

use super::gpu::{Buffer, Gpu, Kernel};
use super::{Error, Result};

/// Workgroups along one axis of a dispatch; WebGPU promises no more.
const MAX_GROUPS: usize = 65_535;

/// A driver that answers in no such time hangs.
const PATIENCE: u64 = 120;

/// Work being written down; nothing runs before `submit`.
pub struct Work<'a> {
    gpu: &'a Gpu,
    encoder: CommandEncoder,
}

/// Results on their way.
pub struct Pending<'a> {
    gpu: &'a Gpu,
    index: wgpu::SubmissionIndex,
    reads: Vec<(wgpu::Buffer, Receiver<bool>)>,
}

impl<'a> Work<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu.device.create_command_encoder(&Default::default());
        Self { gpu, encoder }
    }

    /// Runs a kernel in `groups` workgroups. Binding 0 holds `constants` (none if empty); `buffers` follow.
    ///
    /// Groups beyond a row of the dispatch go on in its next; kernels count y·(groups along x) + x.
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

    /// The same, with the binding of each buffer: for kernels that do not use all that their file declares.
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
        let constants = (!constants.is_empty()).then(|| self.gpu.constants(constants));
        let first = constants.iter().map(|buffer| (0, buffer));
        let rest = buffers.iter().map(|(at, buffer)| (*at, &buffer.inner));
        let entries: Vec<_> = first
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
            timestamp_writes: None,
        });
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        let rows = groups.div_ceil(MAX_GROUPS);
        pass.dispatch_workgroups(groups.div_ceil(rows) as u32, rows as u32, 1);
        Ok(())
    }

    /// Sets a buffer to zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.encoder.clear_buffer(&buffer.inner, 0, None);
    }

    /// Starts it all; the words asked for (of a buffer, from its start) are read when it is done.
    pub fn submit(mut self, reads: &[(&Buffer, usize)]) -> Result<Pending<'a>> {
        let copies: Vec<_> = reads
            .iter()
            .map(|(buffer, words)| {
                let size = 4 * (*words).max(1) as u64;
                let copy = self.gpu.device.create_buffer(&BufferDescriptor {
                    label: Some("readback"),
                    size,
                    usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
                    mapped_at_creation: false,
                });
                self.encoder
                    .copy_buffer_to_buffer(&buffer.inner, 0, &copy, 0, size);
                copy
            })
            .collect();
        let index = self.gpu.queue.submit([self.encoder.finish()]);
        self.gpu.check()?;
        let reads = copies
            .into_iter()
            .map(|copy| {
                let (send, receive) = channel();
                copy.map_async(MapMode::Read, .., move |result| {
                    let _ = send.send(result.is_ok()); // the receiver may have given up
                });
                (copy, receive)
            })
            .collect();
        Ok(Pending {
            gpu: self.gpu,
            index,
            reads,
        })
    }
}

impl Pending<'_> {
    /// Waits; the words of each read.
    pub fn take(self) -> Result<Vec<Vec<u32>>> {
        let waited = self.gpu.device.poll(PollType::Wait {
            submission_index: Some(self.index),
            timeout: Some(Duration::from_secs(PATIENCE)),
        });
        if waited.is_err() {
            self.gpu.fail(Error::Timeout(PATIENCE));
        }
        self.gpu.check()?;
        let lost = || Error::Lost("its memory could not be read".to_owned());
        self.reads
            .iter()
            .map(|(copy, mapped)| {
                let seconds = Duration::from_secs(PATIENCE);
                if !mapped.recv_timeout(seconds).unwrap_or(false) {
                    return Err(lost());
                }
                let view = copy.get_mapped_range(..).map_err(|_| lost())?;
                Ok(bytemuck::pod_collect_to_vec(&view[..]))
            })
            .collect()
    }
}
