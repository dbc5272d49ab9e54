//! The weight of a row without views: an estimate of Σ αT².

use super::cost::Node;

/// m^a · α^b, in units of the median mass.
///
/// If all Gaussians have about the same size, or grow with the distance from the middle as in an unbounded scene, large
/// ones fill as much of an image as their size says, and a is 1. If sizes spread for another reason, large ones are
/// plain or hidden and small ones carry the detail, so all have equal weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Importance {
    /// a.
    pub exponent: f64,
    /// The median mass.
    pub usual: f64,
}

/// What [`Importance::of_scene`] measures of a row.
#[derive(Debug, Clone, Copy)]
pub struct Measured {
    mass: f32,
    alpha: f32,
    /// Distance from the middle.
    radius: f64,
}

impl From<Node> for Measured {
    fn from(node: Node) -> Self {
        let squares = node.mean.iter().map(|v| f64::from(*v).powi(2));
        Self {
            mass: node.mass,
            alpha: node.alpha,
            radius: squares.sum::<f64>().sqrt(),
        }
    }
}

impl Default for Importance {
    fn default() -> Self {
        Self {
            exponent: 1.0,
            usual: 1.0,
        }
    }
}

/// Standard deviation of ln m: at the first a is 1, at the second 0. Measured: playbot 1.0, taebak 1.4, showroom 1.9,
/// guitar 2.1.
const SPREAD: (f64, f64) = (1.0, 2.0);
/// Correlation of ln A with the logarithm of the distance from the middle, from which on sizes follow it in part,
/// and altogether. Measured: paljassaare 0.6, objects and rooms under 0.15.
const FOLLOWS: (f64, f64) = (0.25, 0.45);
/// b where a is 0: faint layers count a little more than their share.
const FAINT: f64 = -0.4;

impl Importance {
    /// Measures a scene: the spread of its masses, and how far sizes follow the distance from the middle.
    pub fn of_scene(rows: &[Measured]) -> Self {
        let shown = || rows.iter().filter(|n| n.mass > 0.0 && n.alpha > 0.0);
        let Some(usual) = median(shown().map(|n| n.mass).collect()) else {
            return Self::default();
        };
        let masses = Moments::of(shown().map(|n| (f64::from(n.mass).ln(), 0.0)));
        let sizes = Moments::of(shown().filter(|n| n.radius > 0.0).map(|n| {
            let area = f64::from(n.mass) / f64::from(n.alpha);
            (area.ln(), n.radius.ln())
        }));
        let spread = ramp(masses.deviation(), SPREAD);
        let own = 1.0 - ramp(sizes.correlation(), FOLLOWS);
        Self {
            exponent: 1.0 - spread * own,
            usual: f64::from(usual),
        }
    }

    /// The estimate of a node's Σ αT².
    pub fn of(&self, node: &Node) -> f32 {
        if self.exponent == 1.0 {
            return node.mass;
        }
        let alpha = f64::from(node.alpha).max(f64::MIN_POSITIVE);
        let share = (f64::from(node.mass) / self.usual).powf(self.exponent);
        (self.usual * share * alpha.powf(FAINT * (1.0 - self.exponent))) as f32
    }
}

/// 0 up to the first, 1 from the second on.
fn ramp(value: f64, (from, to): (f64, f64)) -> f64 {
    ((value - from) / (to - from)).clamp(0.0, 1.0)
}

/// Sums of pairs, one after another: their order decides the last bits.
#[derive(Default)]
struct Moments {
    count: f64,
    mean: [f64; 2],
    square: [f64; 2],
    product: f64,
}

impl Moments {
    fn of(pairs: impl Iterator<Item = (f64, f64)>) -> Self {
        pairs.fold(Self::default(), |mut s, (x, y)| {
            s.count += 1.0;
            let (dx, dy) = (x - s.mean[0], y - s.mean[1]);
            s.mean[0] += dx / s.count;
            s.mean[1] += dy / s.count;
            s.square[0] += dx * (x - s.mean[0]);
            s.square[1] += dy * (y - s.mean[1]);
            s.product += dx * (y - s.mean[1]);
            s
        })
    }

    /// Standard deviation of the first variable.
    fn deviation(&self) -> f64 {
        (self.square[0] / self.count.max(1.0)).sqrt()
    }

    fn correlation(&self) -> f64 {
        let scale = (self.square[0] * self.square[1]).sqrt();
        if scale > 0.0 {
            self.product / scale
        } else {
            0.0
        }
    }
}

/// The middle value; `None` for no values.
pub fn median(mut values: Vec<f32>) -> Option<f32> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows on a line, `step` apart, with scales given by `size`.
    fn line(count: usize, size: impl Fn(usize) -> f32) -> Vec<Node> {
        let node = |i: usize| {
            let s = size(i);
            Node {
                mean: [i as f32 + 1.0, 0.0, 0.0],
                cov: [s * s, 0.0, 0.0, s * s, 0.0, 0.01 * s * s],
                alpha: 0.2,
                ..Node::default()
            }
            .weighed()
        };
        (0..count).map(node).collect()
    }

    fn measured(nodes: &[Node]) -> Importance {
        let rows: Vec<_> = nodes.iter().map(|&node| node.into()).collect();
        Importance::of_scene(&rows)
    }

    #[test]
    fn one_size_counts_by_area_a_spread_by_number_and_distance_explains_it() {
        let exponent = |nodes: &[Node]| measured(nodes).exponent;
        assert_eq!(exponent(&line(500, |_| 0.1)), 1.0);
        let spread = line(500, |i| 0.01 * ((i * 7919 % 500) as f32 / 60.0).exp());
        assert_eq!(exponent(&spread), 0.0);
        let growing = line(500, |i| 0.01 * (i as f32 + 1.0));
        assert_eq!(exponent(&growing), 1.0);
        let half = line(500, |i| 0.01 * ((i * 7919 % 500) as f32 / 192.0).exp());
        assert!((0.3..0.7).contains(&exponent(&half)), "{}", exponent(&half));
    }

    #[test]
    fn sizes_follow_the_distance_whatever_the_opacities() {
        let exponent = |faint: f32| {
            let mut nodes = line(500, |i| 0.01 * (i as f32 + 1.0));
            for (i, node) in nodes.iter_mut().enumerate() {
                node.alpha = if i % 2 == 0 { 0.9 } else { faint };
                *node = node.weighed();
            }
            measured(&nodes).exponent
        };
        assert_eq!(exponent(0.9), 1.0);
        assert_eq!(exponent(0.000_1), 1.0);
    }

    #[test]
    fn sizes_unlike_the_distance_count_by_number() {
        // Size falls with the distance: no unbounded scene.
        let falling = line(500, |i| 0.01 * (10.0 - i as f32 / 50.0).exp());
        assert_eq!(measured(&falling).exponent, 0.0);
        let pairs = [(1.0, 2.0), (2.0, 4.5), (3.0, 5.5), (4.0, 9.0), (5.0, 7.0)];
        let moments = Moments::of(pairs.into_iter());
        assert!((moments.deviation() - 2f64.sqrt()).abs() < 1e-12);
        assert!((moments.correlation() - 14.5 / (10.0 * 27.7f64).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn counted_alike_a_row_weighs_what_the_median_does() {
        let nodes = line(501, |i| 0.01 * ((i * 7919 % 501) as f32 / 60.0).exp());
        let by = measured(&nodes);
        let (low, high) = (by.of(&nodes[0]), by.of(&nodes[500]));
        assert_eq!(low, high);
        assert!((f64::from(low) / by.usual - 0.2f64.powf(FAINT)).abs() < 1e-6);
        assert_eq!(Importance::default().of(&nodes[3]), nodes[3].mass);
    }
}
