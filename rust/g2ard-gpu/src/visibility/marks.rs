//! Rows that a view may show, and how much there is to draw of them.

use std::ops::Range;

use g2ard_core::select::Pinhole;

use super::scene::Scene;
use super::view::Constants;
use super::{BLOCK, FAR, SPLAT};
use crate::runtime::{Buffer, Error, Kernel, Pending, Result, Work};
use crate::scan;

pub const PROJECTION: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("mark.wgsl")];
const MARK: Kernel = Kernel {
    name: "visibility.mark",
    sources: PROJECTION,
    entry: "mark",
};
const DEPTHS: Kernel = Kernel {
    name: "visibility.depths",
    sources: PROJECTION,
    entry: "depths",
};

/// Depths are told apart by these upper bits, sign not among them, where a scene is drawn in slabs.
const DEPTH_SHIFT: u32 = 19;
const DEPTH_BINS: usize = 1 << (31 - DEPTH_SHIFT);
/// Pairs of splat and tile that prefix sums can count.
const MAX_PAIRS: u64 = 1 << 31;

/// Marks on their way.
pub struct Marked<'a> {
    sums: Buffer,
    pending: Pending<'a>,
}

pub struct Marks {
    /// How many marked rows come before each.
    pub sums: Buffer,
    pub splats: usize,
    /// Pairs that they make with tiles.
    pub pairs: u64,
}

impl Marked<'_> {
    pub fn counted(self) -> Result<Marks> {
        let found = self.pending.take()?;
        let splats = found[0].first().map_or(0, |&n| n as usize);
        let pairs = found[1].iter().map(|&t| u64::from(t)).sum();
        Ok(Marks {
            sums: self.sums,
            splats,
            pairs: if splats == 0 { 0 } else { pairs },
        })
    }
}

impl<'a> Scene<'a> {
    /// Marks the rows that the view may show at depths (as bits) within `range`.
    pub fn mark(
        &self,
        mut work: Work<'a>,
        view: &Pinhole,
        range: Range<u32>,
    ) -> Result<Marked<'a>> {
        let blocks = self.count.div_ceil(BLOCK);
        let marks = self.gpu.buffer("marks", self.count + 1)?;
        let tiles = self.gpu.buffer("tiles", blocks)?;
        for (first, count, piece) in self.pieces() {
            let constants = Constants {
                first,
                range: range.clone(),
                ..Constants::new(view, count)
            };
            let buffers = [piece, &marks, &tiles];
            work.run(&MARK, count.div_ceil(BLOCK), &constants.words(), &buffers)?;
        }
        let total = scan::exclusive(self.gpu, &mut work, &marks, self.count + 1)?;
        let pending = work.submit(&[(&total, 1), (&tiles, blocks)])?;
        Ok(Marked {
            sums: marks,
            pending,
        })
    }

    /// Whether they can be drawn at once.
    pub fn fits(&self, marks: &Marks) -> bool {
        marks.splats <= self.most_splats() && marks.pairs < MAX_PAIRS
    }

    fn most_splats(&self) -> usize {
        self.gpu.max_words() / SPLAT
    }

    pub fn check_pairs(&self, marks: &Marks) -> Result<()> {
        if marks.pairs < MAX_PAIRS {
            return Ok(());
        }
        Err(Error::TooMany {
            what: "pairs of splat and tile at one depth of a view",
            count: marks.pairs,
            limit: MAX_PAIRS - 1,
        })
    }

    /// Ranges of depth that each hold no more splats than fit, nearest first.
    pub fn slabs(&self, view: &Pinhole) -> Result<Vec<Range<u32>>> {
        let histogram = self.gpu.buffer("depths", DEPTH_BINS)?;
        let mut work = Work::new(self.gpu);
        for (_, count, piece) in self.pieces() {
            let constants = Constants::new(view, count).words();
            let bound = [(1, piece), (4, &histogram)];
            work.run_at(&DEPTHS, count.div_ceil(BLOCK), &constants, &bound)?;
        }
        let counts = work.submit(&[(&histogram, DEPTH_BINS)])?.take()?;
        let most = self.most_splats();
        let (mut slabs, mut first, mut held) = (Vec::new(), 0, 0);
        for (bin, &count) in counts[0].iter().enumerate() {
            let count = count as usize;
            if count > most {
                return Err(Error::TooMany {
                    what: "splats at one depth of a view",
                    count: count as u64,
                    limit: most as u64,
                });
            }
            if held + count > most {
                slabs.push((first as u32) << DEPTH_SHIFT..(bin as u32) << DEPTH_SHIFT);
                (first, held) = (bin, 0);
            }
            held += count;
        }
        slabs.push((first as u32) << DEPTH_SHIFT..FAR);
        Ok(slabs)
    }
}
