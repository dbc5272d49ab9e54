//! Groups in batches that fit the device; while it computes one, the next is assembled on the CPU.

use g2ard_core::Control;
use g2ard_core::simplify::Group;
use rayon::prelude::*;

use crate::rows::{Part, Rows};
use crate::runtime::{Buffer, Gpu, Kernel, Pending, Result, Work};

/// A kernel with one thread for each group.
pub struct Twin {
    pub kernel: Kernel,
    /// What it reads of the members.
    pub part: Part,
    /// Words of an answer.
    pub answer: usize,
}

/// Rows as the device has them, the numbers they go by, and what else a kernel reads.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    pub rows: &'a Rows,
    pub numbers: &'a [u32],
    pub extra: Option<&'a Buffer>,
    /// What a kernel reads beside them.
    pub constants: [u32; 2],
}

pub struct Found {
    /// `answer` words for each group, zeros for the large ones.
    pub answers: Vec<u32>,
    /// Groups too large for one thread.
    pub large: Vec<usize>,
}

/// Words that say where a group is.
const SEGMENT: usize = 2;

/// More rows than this would keep one thread busy while all others are idle: such groups are rare and go to the CPU.
const LARGEST: usize = 1024;

/// Rounds of loops that a row takes at most.
const ROUNDS: usize = 160;

/// Rows of a batch: enough to fill a device, few enough that drivers do not time out.
const ROWS: usize = 1 << 19;

/// Groups that are put together between two checks of the control, and by one task.
const CHUNK: usize = 1 << 14;
const TASK: usize = 256;

/// Threads of a workgroup.
const THREADS: usize = 64;

#[derive(Default)]
struct Batch {
    /// The rows of its groups, one group after the other.
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

/// Some groups, and those that are too large.
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

    /// Submits the batch and reads the results of the one before.
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
        // Threads that run side by side take equally long.
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

/// Reads the results of a batch.
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
