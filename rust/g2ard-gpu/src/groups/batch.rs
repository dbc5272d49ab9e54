//! Groups in batches that fit the device; while it computes one, the next is put together here.

use g2ard_core::Control;
use g2ard_core::backend::Group;
use rayon::prelude::*;

use crate::runtime::{Buffer, Gpu, Kernel, Pending, Result, Work};

/// A kernel with one thread for each group.
pub struct Twin {
    pub kernel: Kernel,
    /// Words of a member, and of an answer.
    pub member: usize,
    pub answer: usize,
}

pub struct Found {
    /// `answer` words for each group, zeros for the large ones.
    pub answers: Vec<u32>,
    /// Groups too large for one thread.
    pub large: Vec<usize>,
}

/// Words that say where a group is.
const SEGMENT: usize = 3;

/// More rows than this would keep one thread busy while all others wait: such groups are rare, and the CPU's.
const LARGEST: usize = 1024;

/// Rounds of loops that a row takes at most, all fits without a row of leverage 1 counted.
const ROUNDS: usize = 375;

/// Rows of a batch: enough to fill a device, few enough that drivers do not lose patience.
const ROWS: usize = 1 << 19;

/// Groups that are put together between two looks at the control, and by one task.
const CHUNK: usize = 1 << 14;
const TASK: usize = 256;

/// Threads of a workgroup.
const THREADS: usize = 64;

#[derive(Default)]
struct Batch {
    words: Vec<u32>,
    groups: Vec<Segment>,
}

#[derive(Clone, Copy)]
struct Segment {
    id: usize,
    first: u32,
    count: u32,
    own: u32,
}

/// Runs a kernel over all groups. `fill` writes the words of a group's rows.
pub fn run(
    gpu: &Gpu,
    twin: &Twin,
    count: usize,
    group: &Group<'_>,
    fill: &(dyn Fn(&[u32], &mut Vec<u32>) + Sync),
    extra: &[&Buffer],
    control: &Control,
) -> Result<Found> {
    let most_words = gpu.max_words().min(ROWS * twin.member);
    let most_groups = gpu.max_words() / twin.answer.max(SEGMENT);
    let largest = LARGEST
        .min(most_words / twin.member)
        .min(gpu.max_rounds() / ROUNDS);
    let mut found = Found {
        answers: vec![0; count * twin.answer],
        large: Vec::new(),
    };
    let (mut batch, mut flight) = (Batch::default(), None);
    for first in (0..count).step_by(CHUNK) {
        control.check()?;
        let ids: Vec<usize> = (first..count.min(first + CHUNK)).collect();
        let parts: Vec<_> = ids
            .par_chunks(TASK)
            .map(|ids| part(ids, largest, group, fill))
            .collect();
        for (part, large) in parts {
            found.large.extend(large);
            let mut from = 0;
            for segment in part.groups {
                let to = from + segment.count as usize * twin.member;
                if batch.words.len() + to - from > most_words || batch.groups.len() == most_groups {
                    batch.start(gpu, twin, extra, &mut flight, &mut found)?;
                }
                batch.push(twin, segment, &part.words[from..to]);
                from = to;
            }
        }
    }
    batch.start(gpu, twin, extra, &mut flight, &mut found)?;
    land(twin, &mut flight, &mut found)?;
    Ok(found)
}

/// Some groups' words, and those that are too large.
fn part(
    ids: &[usize],
    largest: usize,
    group: &Group<'_>,
    fill: &(dyn Fn(&[u32], &mut Vec<u32>) + Sync),
) -> (Batch, Vec<usize>) {
    let (mut batch, mut large, mut rows) = (Batch::default(), Vec::new(), Vec::new());
    for &id in ids {
        rows.clear();
        let own = group(id, &mut rows);
        if rows.len() > largest {
            large.push(id);
            continue;
        }
        fill(&rows, &mut batch.words);
        batch.groups.push(Segment {
            id,
            first: 0,
            count: rows.len() as u32,
            own: own as u32,
        });
    }
    (batch, large)
}

/// A batch on the device, and whose answers it will leave.
type Flight<'a> = Option<(Vec<usize>, Pending<'a>)>;

impl Batch {
    fn push(&mut self, twin: &Twin, segment: Segment, words: &[u32]) {
        let first = (self.words.len() / twin.member) as u32;
        self.groups.push(Segment { first, ..segment });
        self.words.extend_from_slice(words);
    }

    /// Sends the batch off and takes in the one before.
    fn start<'a>(
        &mut self,
        gpu: &'a Gpu,
        twin: &Twin,
        extra: &[&Buffer],
        flight: &mut Flight<'a>,
        found: &mut Found,
    ) -> Result<()> {
        let Self { words, mut groups } = std::mem::take(self);
        if groups.is_empty() {
            return Ok(());
        }
        // Threads that run side by side take equally long.
        groups.sort_by_key(|g| std::cmp::Reverse(g.count));
        let segments: Vec<[u32; SEGMENT]> =
            groups.iter().map(|g| [g.first, g.count, g.own]).collect();
        let members = gpu.upload("members", &words)?;
        let segments = gpu.upload("groups", segments.as_flattened())?;
        let answers = gpu.buffer("answers", groups.len() * twin.answer)?;
        let mut buffers = vec![&members, &segments, &answers];
        buffers.extend_from_slice(extra);
        let mut work = Work::new(gpu);
        let constants = [groups.len() as u32, 0, 0, 0];
        work.run(
            &twin.kernel,
            groups.len().div_ceil(THREADS),
            &constants,
            &buffers,
        )?;
        let pending = work.submit(&[(&answers, groups.len() * twin.answer)])?;
        land(twin, flight, found)?;
        *flight = Some((groups.iter().map(|g| g.id).collect(), pending));
        Ok(())
    }
}

/// Takes in what a batch left.
fn land(twin: &Twin, flight: &mut Flight<'_>, found: &mut Found) -> Result<()> {
    let Some((ids, pending)) = flight.take() else {
        return Ok(());
    };
    let words = pending.take()?;
    for (id, answer) in ids.into_iter().zip(words[0].chunks(twin.answer)) {
        let at = id * twin.answer;
        found.answers[at..at + twin.answer].copy_from_slice(answer);
    }
    Ok(())
}
