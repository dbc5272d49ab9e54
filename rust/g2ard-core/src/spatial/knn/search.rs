//! A search for the nearest of eight points at a time.

use super::coordinate::{Coordinate, Neighbor};
use super::{Lanes, WIDTH};

/// Neighbours of the eight points of a block found so far.
pub struct Search<T: Coordinate> {
    pub k: usize,
    pub points: [Lanes<T>; 3],
    /// Distances beyond which no point can be among the nearest.
    pub limits: Lanes<T>,
    /// The nearest `k` of every point, ascending.
    keys: Vec<T::Key>,
}

impl<T: Coordinate> Search<T> {
    pub fn new(k: usize) -> Self {
        Self {
            k,
            points: [[T::default(); WIDTH]; 3],
            limits: [T::default(); WIDTH],
            keys: vec![Self::nothing(); WIDTH * k],
        }
    }

    /// A key beyond all others.
    fn nothing() -> T::Key {
        T::INFINITY.key(u32::MAX)
    }

    /// Starts anew at the points that are set in `lanes`.
    pub fn begin(&mut self, points: &[Lanes<T>; 3], lanes: u32) {
        self.points = *points;
        for lane in 0..WIDTH {
            let searched = lanes & 1 << lane != 0;
            self.limits[lane] = if searched { T::MAX } else { T::NEG_INFINITY };
        }
        self.keys.fill(Self::nothing());
    }

    /// The largest limit of the eight.
    #[inline(always)]
    pub fn limit(&self) -> T {
        let mut limit = self.limits[0];
        for lane in 1..WIDTH {
            limit = limit.most(self.limits[lane]);
        }
        limit
    }

    #[inline(always)]
    pub fn offer(&mut self, lane: usize, new: T::Key) {
        let keys = &mut self.keys[lane * self.k..(lane + 1) * self.k];
        let mut at = keys.len() - 1;
        if new >= keys[at] {
            return;
        }
        while at > 0 && new < keys[at - 1] {
            keys[at] = keys[at - 1];
            at -= 1;
        }
        keys[at] = new;
        self.limits[lane] = T::of_key(keys[keys.len() - 1]).0.least(T::MAX);
    }

    pub fn found(&self, lane: usize) -> impl Iterator<Item = Neighbor<T>> {
        let keys = self.keys[lane * self.k..(lane + 1) * self.k].iter();
        keys.take_while(|&&key| key != Self::nothing())
            .map(|&key| T::of_key(key))
    }
}
