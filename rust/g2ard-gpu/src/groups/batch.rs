//! Groups in batches that fit the device. The CPU assembles one batch while the device computes the previous one.

use g2ard_core::Control;
use g2ard_core::simplify::Group;
use rayon::prelude::*;

use crate::rows::{Part, Run};
use crate::runtime::{Buffer, Kernel, Pending, Result, Work};

/// A kernel with one thread per group.
pub struct Twin<'a> {
    pub kernel: &'a Kernel,
    /// The part of a member's row that it reads.
    pub part: Part,
    /// Words per answer.
    pub answer: usize,
    /// A further input, and further constants.
    pub extra: Option<&'a Buffer>,
    pub constants: [u32; 2],
}

pub struct Found {
    /// `answer` words per group; zeros for large groups.
    pub answers: Vec<u32>,
    /// Groups too large for one thread.
    pub large: Vec<usize>,
}

/// Words that locate a group.
const SEGMENT: usize = 2;

/// Largest group that a thread processes. Larger ones would keep one thread busy while others idle; they are rare and
/// go to the CPU.
const LARGEST: usize = 1024;

/// Most loop iterations per row.
const ROUNDS: usize = 160;

/// Rows per batch: enough to fill a device, few enough that drivers do not time out.
const ROWS: usize = 1 << 19;

/// Groups per task, and between two checks of the control.
const CHUNK: usize = 1 << 14;
const TASK: usize = 256;

/// Threads per workgroup.
const THREADS: usize = 64;

#[derive(Default)]
struct Batch {
    /// Rows of all groups, one group after the other.
    rows: Vec<u32>,
    groups: Vec<Segment>,
}

#[derive(Clone, Copy)]
struct Segment {
    id: usize,
    first: u32,
    count: u32,
    own: u32,
}

/// Run a kernel over all groups.
pub fn run_twin(
    run: Run<'_>,
    twin: &Twin,
    count: usize,
    group: &Group<'_>,
    control: &Control,
) -> Result<Found> {
    let most_rows = (run.gpu.max_words() / twin.part.words).min(ROWS);
    let most_groups = run.gpu.max_words() / twin.answer.max(SEGMENT);
    let largest = LARGEST.min(most_rows).min(run.gpu.max_rounds() / ROUNDS);
    let mut batches = Batches {
        run,
        twin,
        submitted: None,
        answers: vec![0; count * twin.answer],
    };
    let (mut batch, mut large) = (Batch::default(), Vec::new());
    for first in (0..count).step_by(CHUNK) {
        control.check()?;
        let ids: Vec<usize> = (first..count.min(first + CHUNK)).collect();
        let parts: Vec<_> = ids
            .par_chunks(TASK)
            .map(|ids| part(ids, largest, group))
            .collect();
        for (part, too_large) in parts {
            large.extend(too_large);
            for segment in part.groups {
                let rows = &part.rows[segment.first as usize..][..segment.count as usize];
                let full = batch.rows.len() + rows.len() > most_rows;
                if full || batch.groups.len() == most_groups {
                    batches.start(std::mem::take(&mut batch))?;
                }
                batch.push(segment.id, segment.own, rows);
            }
        }
    }
    batches.start(batch)?;
    batches.finish()?;
    Ok(Found {
        answers: batches.answers,
        large,
    })
}

/// Assemble some groups; return the batch and the groups that are too large.
fn part(ids: &[usize], largest: usize, group: &Group<'_>) -> (Batch, Vec<usize>) {
    let (mut batch, mut large, mut rows) = (Batch::default(), Vec::new(), Vec::new());
    for &id in ids {
        rows.clear();
        let own = group(id, &mut rows);
        if rows.len() > largest {
            large.push(id);
            continue;
        }
        batch.push(id, own as u32, &rows);
    }
    (batch, large)
}

impl Batch {
    fn push(&mut self, id: usize, own: u32, rows: &[u32]) {
        self.groups.push(Segment {
            id,
            first: self.rows.len() as u32,
            count: rows.len() as u32,
            own,
        });
        self.rows.extend_from_slice(rows);
    }
}

/// Batches on their way: one at most is submitted, with the groups whose results it holds.
struct Batches<'a> {
    run: Run<'a>,
    twin: &'a Twin<'a>,
    submitted: Option<(Vec<usize>, Pending<'a>)>,
    answers: Vec<u32>,
}

impl Batches<'_> {
    /// Submit a batch and read the results of the previous one.
    fn start(&mut self, batch: Batch) -> Result<()> {
        let Batch { rows, mut groups } = batch;
        if groups.is_empty() {
            return Ok(());
        }
        // Sort by size, so that threads which run together take equally long.
        groups.sort_by_key(|g| std::cmp::Reverse(g.count));
        let segments: Vec<[u32; SEGMENT]> = groups
            .iter()
            .map(|g| [g.first, g.own << 16 | g.count])
            .collect();
        let (gpu, twin) = (self.run.gpu, self.twin);
        let mut work = Work::new(gpu);
        let members = self.run.gather(&mut work, twin.part, &rows)?;
        let segments = gpu.upload("groups", segments.as_flattened())?;
        let words = groups.len() * twin.answer;
        let answers = gpu.buffer("answers", words)?;
        let mut buffers = vec![&members, &segments, &answers];
        buffers.extend(twin.extra);
        let [a, b] = twin.constants;
        let constants = [groups.len() as u32, a, b, 0];
        let threads = groups.len().div_ceil(THREADS);
        work.run(twin.kernel, threads, &constants, &buffers)?;
        let pending = work.submit(&[(&answers, words)])?;
        self.finish()?;
        self.submitted = Some((groups.iter().map(|g| g.id).collect(), pending));
        Ok(())
    }

    /// Read the results of the submitted batch.
    fn finish(&mut self) -> Result<()> {
        let Some((ids, pending)) = self.submitted.take() else {
            return Ok(());
        };
        let words = pending.take()?;
        for (id, answer) in ids.into_iter().zip(words[0].chunks(self.twin.answer)) {
            let at = id * self.twin.answer;
            self.answers[at..at + self.twin.answer].copy_from_slice(answer);
        }
        Ok(())
    }
}
