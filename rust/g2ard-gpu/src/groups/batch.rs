//! Groups in batches that fit the device. The CPU assembles one batch while the device computes the previous one.

use g2ard_core::Control;
use g2ard_core::simplify::Group;
use rayon::prelude::*;

use crate::rows::{Part, Rows};
use crate::runtime::{Buffer, Gpu, Kernel, Pending, Result, Work};

/// A kernel with one thread per group.
pub struct Twin {
    pub kernel: Kernel,
    /// The part of a member's row that it reads.
    pub part: Part,
    /// Words per answer.
    pub answer: usize,
}

/// Rows on the device, their numbers, and further inputs of a kernel.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    pub rows: &'a Rows,
    pub numbers: &'a [u32],
    pub extra: Option<&'a Buffer>,
    /// Further constants of the kernel.
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

/// Runs a kernel over all groups.
pub fn run(
    gpu: &Gpu,
    twin: &Twin,
    source: Source<'_>,
    count: usize,
    group: &Group<'_>,
    control: &Control,
) -> Result<Found> {
    let most_rows = (gpu.max_words() / twin.part.words).min(ROWS);
    let most_groups = gpu.max_words() / twin.answer.max(SEGMENT);
    let largest = LARGEST.min(most_rows).min(gpu.max_rounds() / ROUNDS);
    let mut found = Found {
        answers: vec![0; count * twin.answer],
        large: Vec::new(),
    };
    let (mut batch, mut submitted) = (Batch::default(), None);
    for first in (0..count).step_by(CHUNK) {
        control.check()?;
        let ids: Vec<usize> = (first..count.min(first + CHUNK)).collect();
        let parts: Vec<_> = ids
            .par_chunks(TASK)
            .map(|ids| part(ids, largest, group))
            .collect();
        for (part, large) in parts {
            found.large.extend(large);
            let mut from = 0;
            for segment in part.groups {
                let to = from + segment.count as usize;
                if batch.rows.len() + to - from > most_rows || batch.groups.len() == most_groups {
                    batch.start(gpu, twin, source, &mut submitted, &mut found)?;
                }
                batch.push(segment.id, segment.own, &part.rows[from..to]);
                from = to;
            }
        }
    }
    batch.start(gpu, twin, source, &mut submitted, &mut found)?;
    finish(twin, &mut submitted, &mut found)?;
    Ok(found)
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

/// A submitted batch, and the groups whose results it holds.
type Submitted<'a> = Option<(Vec<usize>, Pending<'a>)>;

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

    /// Submit the batch and read the results of the previous one.
    fn start<'a>(
        &mut self,
        gpu: &'a Gpu,
        twin: &Twin,
        source: Source<'_>,
        submitted: &mut Submitted<'a>,
        found: &mut Found,
    ) -> Result<()> {
        let Self { rows, mut groups } = std::mem::take(self);
        if groups.is_empty() {
            return Ok(());
        }
        // Sort by size, so that threads which run together take equally long.
        groups.sort_by_key(|g| std::cmp::Reverse(g.count));
        let segments: Vec<[u32; SEGMENT]> = groups
            .iter()
            .map(|g| [g.first, g.own << 16 | g.count])
            .collect();
        let numbers: Vec<u32> = rows.iter().map(|&i| source.numbers[i as usize]).collect();
        let mut work = Work::new(gpu);
        let members = source.rows.gather(gpu, &mut work, twin.part, &numbers)?;
        let segments = gpu.upload("groups", segments.as_flattened())?;
        let answers = gpu.buffer("answers", groups.len() * twin.answer)?;
        let mut buffers = vec![&members, &segments, &answers];
        buffers.extend(source.extra);
        let [a, b] = source.constants;
        let constants = [groups.len() as u32, a, b, 0];
        work.run(
            &twin.kernel,
            groups.len().div_ceil(THREADS),
            &constants,
            &buffers,
        )?;
        let pending = work.submit(&[(&answers, groups.len() * twin.answer)])?;
        finish(twin, submitted, found)?;
        *submitted = Some((groups.iter().map(|g| g.id).collect(), pending));
        Ok(())
    }
}

/// Read the results of a batch.
fn finish(twin: &Twin, submitted: &mut Submitted<'_>, found: &mut Found) -> Result<()> {
    let Some((ids, pending)) = submitted.take() else {
        return Ok(());
    };
    let words = pending.take()?;
    for (id, answer) in ids.into_iter().zip(words[0].chunks(twin.answer)) {
        let at = id * twin.answer;
        found.answers[at..at + twin.answer].copy_from_slice(answer);
    }
    Ok(())
}
