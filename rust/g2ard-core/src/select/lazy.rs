//! Greedy maximisation of a monotone submodular objective over views.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use rayon::prelude::*;

use crate::{Control, Result};

/// A monotone submodular function of a set of views that grows one view at a time.
pub trait Objective: Sync {
    /// Number of candidates.
    fn views(&self) -> usize;
    /// What adding a view would gain.
    fn gain(&self, view: usize) -> f64;
    fn add(&mut self, view: usize);
}

/// Views in the order they were chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct Chosen {
    pub views: Vec<u32>,
    /// F(S ∪ v) − F(S) of each.
    pub gains: Vec<f64>,
    /// Number of gains computed.
    pub evaluations: u64,
}

/// A view and the most it can add; the heap's top has the largest gain and, of equals, the lowest number.
#[derive(PartialEq)]
struct Bound {
    gain: f64,
    view: Reverse<u32>,
    round: usize,
}

impl Eq for Bound {}

impl Ord for Bound {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain
            .total_cmp(&other.gain)
            .then(self.view.cmp(&other.view))
    }
}

impl PartialOrd for Bound {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// Chooses at most `k` views greedily. Gains only shrink as views are added, so an old gain bounds the present one: only the
/// top of the heap is evaluated again (CELF).
pub fn lazy_greedy<O: Objective>(mut objective: O, k: usize, control: &Control) -> Result<Chosen> {
    let count = objective.views();
    let k = k.min(count);
    control.begin(k as u64);
    let gains: Vec<f64> = (0..count)
        .into_par_iter()
        .map(|v| objective.gain(v))
        .collect();
    let mut heap: BinaryHeap<Bound> = (0..)
        .zip(gains)
        .map(|(view, gain)| Bound {
            gain,
            view: Reverse(view),
            round: 0,
        })
        .collect();
    let mut chosen = Chosen {
        views: Vec::new(),
        gains: Vec::new(),
        evaluations: count as u64,
    };
    while chosen.views.len() < k {
        control.check()?;
        let Some(top) = heap.pop() else { break };
        let view = top.view.0;
        let round = chosen.views.len();
        if top.round < round {
            let gain = objective.gain(view as usize);
            chosen.evaluations += 1;
            heap.push(Bound { gain, round, ..top });
            continue;
        }
        objective.add(view as usize);
        chosen.views.push(view);
        chosen.gains.push(top.gain);
        control.advance(1);
    }
    Ok(chosen)
}
