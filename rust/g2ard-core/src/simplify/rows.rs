//! Rows that merging reads: nodes in memory, or nodes made from the scene as they are read (see `leaves`).

use rayon::prelude::*;

use super::clusters::Partition;
use super::cost::Node;
use super::matching::Nodes;

/// Nodes in a fixed order, and their SH.
pub trait Rows: Sync {
    fn len(&self) -> usize;
    /// Values of SH a row.
    fn width(&self) -> usize;
    fn node(&self, i: usize) -> Node;
    /// Band 0.
    fn color(&self, i: usize) -> [f32; 3];
    /// As many values as `out` has, of all bands.
    fn read_sh(&self, i: usize, out: &mut [f32]);

    /// Each run of rows as one node, of the first `width` values of SH.
    fn merged(&self, runs: &Partition, width: usize) -> Nodes {
        let mut ends: Vec<usize> = (1..runs.of.len())
            .filter(|&i| runs.of[i] != runs.of[i - 1])
            .collect();
        ends.push(runs.of.len());
        let mut sh = vec![0.0; runs.count * width];
        let geometry = sh
            .par_chunks_mut(width)
            .enumerate()
            .map(|(run, out)| {
                let from = if run == 0 { 0 } else { ends[run - 1] };
                let mut node = self.node(from);
                let mut added = [0.0; MAX_WIDTH];
                self.read_sh(from, out);
                for i in from + 1..ends[run] {
                    let next = self.node(i);
                    let share = node.share(&next);
                    self.read_sh(i, &mut added[..width]);
                    out.iter_mut()
                        .zip(&added)
                        .for_each(|(p, q)| *p += share * (q - *p));
                    node = node.merged(&next);
                }
                node
            })
            .collect();
        Nodes {
            geometry,
            sh,
            width,
        }
    }
}

/// SH of degree 3, three channels.
const MAX_WIDTH: usize = 48;

impl Rows for Nodes {
    fn len(&self) -> usize {
        self.geometry.len()
    }

    fn width(&self) -> usize {
        self.width
    }

    fn node(&self, i: usize) -> Node {
        self.geometry[i]
    }

    fn color(&self, i: usize) -> [f32; 3] {
        let at = i * self.width;
        [self.sh[at], self.sh[at + 1], self.sh[at + 2]]
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.sh[i * self.width..][..out.len()]);
    }
}

/// Nodes in another order than they lie in: at 13 million, to move them would take half the memory of all.
pub struct Shuffled {
    pub nodes: Nodes,
    pub at: Vec<u32>,
}

impl Shuffled {
    /// The nodes, moved to their places.
    pub fn settled(mut self) -> Nodes {
        self.nodes.gather(&self.at);
        self.nodes
    }
}

impl Rows for Shuffled {
    fn len(&self) -> usize {
        self.at.len()
    }

    fn width(&self) -> usize {
        self.nodes.width
    }

    fn node(&self, i: usize) -> Node {
        self.nodes.node(self.at[i] as usize)
    }

    fn color(&self, i: usize) -> [f32; 3] {
        self.nodes.color(self.at[i] as usize)
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        self.nodes.read_sh(self.at[i] as usize, out);
    }
}
