//! Recorded dispatches, and results to read when they are done.

use std::iter;
use std::time::Duration;

use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BufferUsages, CommandEncoder, ComputePass,
    ComputePassDescriptor, ComputePassTimestampWrites, ComputePipeline, MapMode, PollType,
    QuerySet, QuerySetDescriptor, QueryType,
};

use super::gpu::{Buffer, Constants, Gpu, Kernel};
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
    program: Program,
}

/// Commands with their pipelines and bindings, which can run many times.
#[derive(Clone, Default)]
pub struct Program(Vec<Command>);

#[derive(Clone)]
enum Command {
    Run {
        kernel: &'static str,
        pipeline: ComputePipeline,
        bindings: BindGroup,
        groups: [u32; 2],
    },
    Clear(wgpu::Buffer),
    Copy {
        from: wgpu::Buffer,
        to: wgpu::Buffer,
        bytes: u64,
    },
}

/// Start and end of each kernel.
struct Clock {
    ticks: QuerySet,
    resolved: wgpu::Buffer,
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
        let program = Program::default();
        Self { gpu, program }
    }

    /// Run a program.
    pub fn append(&mut self, program: &Program) {
        self.program.0.extend_from_slice(&program.0);
    }

    /// The commands, to run them many times.
    pub fn program(self) -> Program {
        self.program
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
        let constants = self.gpu.constants(constants);
        self.run_with(kernel, groups, &constants, buffers)
    }

    /// Run a kernel with constants that may change between two runs of a program.
    pub fn run_with(
        &mut self,
        kernel: &Kernel,
        groups: usize,
        constants: &Constants,
        buffers: &[(u32, &Buffer)],
    ) -> Result<()> {
        let pipeline = self.gpu.pipeline(kernel)?;
        let rest = buffers.iter().map(|(at, buffer)| (*at, &buffer.inner));
        let entries: Vec<_> = iter::once((0, &constants.0))
            .chain(rest)
            .map(|(binding, buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let bindings = self.gpu.device.create_bind_group(&BindGroupDescriptor {
            label: Some(kernel.name),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries,
        });
        let rows = groups.div_ceil(MAX_GROUPS);
        self.program.0.push(Command::Run {
            kernel: kernel.name,
            pipeline,
            bindings,
            groups: [groups.div_ceil(rows) as u32, rows as u32],
        });
        Ok(())
    }

    /// Fill a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.program.0.push(Command::Clear(buffer.inner.clone()));
    }

    /// Copy a buffer to the beginning of another.
    pub fn copy(&mut self, from: &Buffer, to: &Buffer) {
        self.program.0.push(Command::Copy {
            from: from.inner.clone(),
            to: to.inner.clone(),
            bytes: 4 * from.words() as u64,
        });
    }

    /// Submit the work. Each of `reads` is a buffer and the number of its first words to read when the work is done.
    pub fn submit(self, reads: &[(&Buffer, usize)]) -> Result<Pending<'a>> {
        let gpu = self.gpu;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let clock = gpu.timed.then(|| Clock::new(gpu));
        let timed = self.program.encode(&mut encoder, clock);
        let mut readback = |from: &wgpu::Buffer, size: u64| {
            let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
            let copy = gpu.create("readback", size, usage);
            encoder.copy_buffer_to_buffer(from, 0, &copy, 0, size);
            copy
        };
        let mut reads: Vec<_> = reads
            .iter()
            .map(|(buffer, words)| readback(&buffer.inner, 4 * (*words).max(1) as u64))
            .collect();
        let timed = timed.map(|(ticks, kernels)| {
            reads.push(readback(&ticks, 16 * kernels.len() as u64));
            kernels
        });
        let index = gpu.queue.submit([encoder.finish()]);
        gpu.check()?;
        for copy in &reads {
            copy.map_async(MapMode::Read, .., |_| {}); // `take` sees whether it succeeded
        }
        Ok(Pending {
            gpu,
            index,
            reads,
            timed,
        })
    }
}

impl Program {
    /// Encode the commands; return the ticks of each kernel if a clock measures them.
    fn encode(
        &self,
        encoder: &mut CommandEncoder,
        mut clock: Option<Clock>,
    ) -> Option<(wgpu::Buffer, Vec<&'static str>)> {
        let mut at = 0;
        while at < self.0.len() {
            if self.0[at].transfer(encoder) {
                at += 1;
                continue;
            }
            // Kernels that are timed have a pass of their own.
            let most = if clock.is_some() { 1 } else { usize::MAX };
            let kernel = self.0[at].kernel();
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor {
                label: kernel,
                timestamp_writes: clock.as_mut().and_then(|c| c.next(kernel?)),
            });
            let run = self.0[at..].iter().take(most);
            at += run
                .take_while(|command| command.dispatch(&mut pass))
                .count();
        }
        clock.and_then(|clock| clock.resolve(encoder))
    }
}

impl Command {
    fn kernel(&self) -> Option<&'static str> {
        match self {
            Self::Run { kernel, .. } => Some(kernel),
            Self::Clear(_) | Self::Copy { .. } => None,
        }
    }

    /// Encode a command outside of passes; false for kernels.
    fn transfer(&self, encoder: &mut CommandEncoder) -> bool {
        match self {
            Self::Run { .. } => return false,
            Self::Clear(buffer) => encoder.clear_buffer(buffer, 0, None),
            Self::Copy { from, to, bytes } => encoder.copy_buffer_to_buffer(from, 0, to, 0, *bytes),
        }
        true
    }

    /// Dispatch a kernel; false for other commands.
    fn dispatch(&self, pass: &mut ComputePass) -> bool {
        let Self::Run {
            pipeline,
            bindings,
            groups: [columns, rows],
            ..
        } = self
        else {
            return false;
        };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, bindings, &[]);
        pass.dispatch_workgroups(*columns, *rows, 1);
        true
    }
}

impl Clock {
    fn new(gpu: &Gpu) -> Self {
        let ticks = gpu.device.create_query_set(&QuerySetDescriptor {
            label: Some("ticks"),
            ty: QueryType::Timestamp,
            count: 2 * MAX_TIMED as u32,
        });
        let size = 16 * MAX_TIMED as u64;
        let usage = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        Self {
            ticks,
            resolved: gpu.create("ticks", size, usage),
            kernels: Vec::new(),
        }
    }

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

    fn resolve(self, encoder: &mut CommandEncoder) -> Option<(wgpu::Buffer, Vec<&'static str>)> {
        if self.kernels.is_empty() {
            return None;
        }
        let count = 2 * self.kernels.len() as u32;
        encoder.resolve_query_set(&self.ticks, 0..count, &self.resolved, 0);
        Some((self.resolved, self.kernels))
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
