//! Position and size of a scene, robust against floaters.

use rayon::prelude::*;

/// A cube about the scene. Its numbers are picked from the data (order statistics, no averages): moving
/// dyadic coordinates, or scaling them by a power of two, moves and scales the bounds exactly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobustBounds {
    /// The per-axis median.
    pub origin: [f64; 3],
    /// Twice the largest distance, along an axis, from the origin to the 1st or 99th percentile. Never 0.
    pub radius: f64,
}

impl RobustBounds {
    pub fn of(points: &[[f64; 3]]) -> Self {
        if points.is_empty() {
            return Self {
                origin: [0.0; 3],
                radius: 1.0,
            };
        }
        let axes: Vec<_> = (0..3usize)
            .into_par_iter()
            .map(|k| Axis::of(points.iter().map(|p| p[k]).collect()))
            .collect();
        let widest = |f: fn(&Axis) -> f64| axes.iter().map(f).fold(0.0, f64::max);
        let (robust, full) = (widest(|a| a.robust), widest(|a| a.full));
        let reach = if robust > 0.0 { robust } else { full };
        Self {
            origin: [0, 1, 2].map(|k| axes[k].median),
            radius: if reach > 0.0 { 2.0 * reach } else { 1.0 },
        }
    }
}

struct Axis {
    median: f64,
    /// Largest distance from the median to the 1st and 99th percentile, and to the extremes.
    robust: f64,
    full: f64,
}

impl Axis {
    fn of(mut values: Vec<f64>) -> Self {
        let last = values.len() - 1;
        let mut pick = |rank: usize| *values.select_nth_unstable_by(rank, f64::total_cmp).1;
        let (median, low, high) = (pick(last / 2), pick(last / 100), pick(last - last / 100));
        let (first, end) = (pick(0), pick(last));
        Self {
            median,
            robust: (median - low).max(high - median),
            full: (median - first).max(end - median),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_do_not_move_it() {
        let mut points: Vec<[f64; 3]> = (0..1000).map(|i| [f64::from(i), 0.0, 1.0]).collect();
        let calm = RobustBounds::of(&points);
        points[7] = [2e7, -2e7, 2e7];
        let wild = RobustBounds::of(&points);
        assert!((calm.radius - wild.radius).abs() <= 4.0);
        assert_eq!(calm.origin[1..], wild.origin[1..]);
    }

    #[test]
    fn one_place_has_a_size_too() {
        assert_eq!(RobustBounds::of(&[[3.0; 3]; 5]).radius, 1.0);
        let mostly = [vec![[0.0; 3]; 999], vec![[5.0, 0.0, 0.0]]].concat();
        assert_eq!(RobustBounds::of(&mostly).radius, 10.0);
    }
}
