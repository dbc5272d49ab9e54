//! The weight of a row that no view sees: an estimate of Σ αT².

use rayon::prelude::*;

use super::cost::Node;
use crate::linalg::{dot, sub};

/// m^a · α^b, in units of the median m, where m is a row's mass as it looks from where people stand.
///
/// If all Gaussians have about the same size, large ones fill as much of an image as their size says, and a is 1. If sizes
/// spread, large ones are plain or hidden and small ones carry the detail, so all have nearly equal weight.
///
/// In an unbounded scene, areas grow with the square of the distance from where its photos were taken: a trainer splits
/// what is larger than a pixel or two. Such a scene says where people stand, and m is its mass over the squared
/// distance from there. Otherwise a few Gaussians of a remote sky would outweigh all that is near. There, too, all have
/// nearly equal weight: each covered about a pixel of the photo that was nearest to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Importance {
    /// a.
    pub exponent: f64,
    /// The median m.
    pub usual: f64,
    /// Where people stand.
    pub place: [f64; 3],
    /// Distances below it count as it: people walk about.
    pub reach: f64,
    /// Share of the exponent 2 of the distance by which masses are divided.
    pub angular: f64,
}

/// What [`Importance::of_scene`] measures of a row.
#[derive(Debug, Clone, Copy)]
pub struct Measured {
    mass: f32,
    alpha: f32,
    mean: [f32; 3],
}

impl From<Node> for Measured {
    fn from(node: Node) -> Self {
        Self {
            mass: node.mass,
            alpha: node.alpha,
            mean: node.mean,
        }
    }
}

impl Default for Importance {
    fn default() -> Self {
        Self {
            exponent: 1.0,
            usual: 1.0,
            place: [0.0; 3],
            reach: 0.0,
            angular: 0.0,
        }
    }
}

/// Standard deviation of ln m: up to the first a is 1, from the second on [`LEAST`].
const SPREAD: (f64, f64) = (1.0, 2.0);
/// The least a. With 0, the showroom's many faint rows would get too much.
const LEAST: f64 = 0.2;
/// Correlation of ln A with the logarithm of the distance from the place, from which on sizes follow it in part, and
/// altogether. Measured: paljassaare 0.7, objects and rooms up to 0.3.
const FOLLOWS: (f64, f64) = (0.25, 0.45);
/// By which power of the distance areas grow: as in a scene without a place, and as they would in angular measure.
/// Measured: paljassaare 1.1, scenes under a sky 1.9 to 2.7.
const GROWS: (f64, f64) = (1.2, 1.5);
/// b where a is 0: faint layers count a little more than their share.
const FAINT: f64 = -0.4;
/// Rows among which the place is sought, and rows that it is to be near.
const PLACES: (usize, usize) = (128, 1024);
/// Distances below this quantile do not make a place better: rows may coincide.
const COINCIDE: f64 = 0.01;
/// People walk about among this share of the rows.
const AMONG: f64 = 0.25;

impl Importance {
    /// Measures a scene: where people stand, the spread of its masses, and how far sizes follow the distance.
    ///
    /// The rows are in Morton order, so that evenly spaced ones are a fair sample.
    pub fn of_scene(rows: &[Measured]) -> Self {
        let shown: Vec<Measured> = rows
            .iter()
            .copied()
            .filter(|n| n.mass > 0.0 && n.alpha > 0.0)
            .collect();
        if shown.is_empty() {
            return Self::default();
        }
        let place = place_of(&shown);
        let distances: Vec<f32> = shown
            .par_iter()
            .map(|n| distance(n.mean.map(f64::from), place) as f32)
            .collect();
        let reach = f64::from(quantile(distances.clone(), AMONG));
        let mut found = Self {
            place,
            reach,
            ..Self::default()
        };
        let sizes = Moments::of(
            shown
                .iter()
                .zip(&distances)
                .map(|(n, &d)| {
                    (
                        f64::from(n.mass) / f64::from(n.alpha),
                        f64::from(d).max(reach),
                    )
                })
                .filter(|&(_, d)| d > 0.0)
                .map(|(area, d)| (area.ln(), d.ln())),
        );
        if reach > 0.0 {
            found.angular = ramp(sizes.slope(), GROWS);
        }
        let apparent: Vec<f32> = shown
            .par_iter()
            .map(|n| found.apparent(n.mean, n.mass))
            .collect();
        let masses = Moments::of(
            apparent
                .iter()
                .filter(|m| **m > 0.0)
                .map(|&m| (f64::from(m).ln(), 0.0)),
        );
        let spread = ramp(masses.deviation(), SPREAD);
        let follows = ramp(sizes.correlation(), FOLLOWS);
        let equal = found
            .angular
            .max(spread * (1.0 - follows * (1.0 - found.angular)));
        found.exponent = LEAST + (1.0 - LEAST) * (1.0 - equal);
        found.usual = f64::from(median(apparent).unwrap_or(1.0));
        found
    }

    /// The same with lengths in units of `unit`, from `origin`.
    pub fn in_units(self, origin: [f64; 3], unit: f64) -> Self {
        Self {
            place: sub(self.place, origin).map(|v| v / unit),
            reach: self.reach / unit,
            ..self
        }
    }

    /// The inverse of [`Self::in_units`].
    pub fn in_scene(self, origin: [f64; 3], unit: f64) -> Self {
        Self {
            place: [0, 1, 2].map(|k| self.place[k] * unit + origin[k]),
            reach: self.reach * unit,
            ..self
        }
    }

    /// How far a scene that says where people stand has small Gaussians that carry the detail, 0 to 1.
    pub fn small_carry_detail(&self) -> f64 {
        (1.0 - self.exponent) * self.angular
    }

    /// A mass as it looks from where people stand, at least as far away as they walk about.
    pub fn apparent(&self, mean: [f32; 3], mass: f32) -> f32 {
        if self.angular == 0.0 {
            return mass;
        }
        let times = (distance(mean.map(f64::from), self.place) / self.reach).max(1.0);
        (f64::from(mass) * times.powf(-2.0 * self.angular)) as f32
    }

    /// The estimate of a node's Σ αT².
    pub fn of(&self, node: &Node) -> f32 {
        let mass = self.apparent(node.mean, node.mass);
        if self.exponent == 1.0 {
            return mass;
        }
        let alpha = f64::from(node.alpha).max(f64::MIN_POSITIVE);
        let share = (f64::from(mass) / self.usual.max(f64::MIN_POSITIVE)).powf(self.exponent);
        (self.usual * share * alpha.powf(FAINT * (1.0 - self.exponent))) as f32
    }
}

/// The row from which the others are nearest in the mean of log distance. A few remote rows do not move it, nor do many
/// on a remote sky, and it does not depend on the scene's unit.
fn place_of(rows: &[Measured]) -> [f64; 3] {
    let some = |count: usize| -> Vec<[f64; 3]> {
        let count = count.min(rows.len());
        let at = |i: usize| rows[(2 * i + 1) * rows.len() / (2 * count)].mean;
        (0..count).map(|i| at(i).map(f64::from)).collect()
    };
    let (places, others) = (some(PLACES.0), some(PLACES.1));
    let distances: Vec<Vec<f32>> = places
        .par_iter()
        .map(|&p| others.iter().map(|&o| distance(o, p) as f32).collect())
        .collect();
    let least = quantile(distances.concat(), COINCIDE).max(f32::MIN_POSITIVE);
    let sums: Vec<f64> = distances
        .par_iter()
        .map(|row| row.iter().map(|&d| f64::from(d.max(least)).ln()).sum())
        .collect();
    let best = (0..places.len()).min_by(|&i, &j| sums[i].total_cmp(&sums[j]));
    best.map_or([0.0; 3], |i| places[i])
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    let delta = sub(a, b);
    dot(delta, delta).sqrt()
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

    /// Of the first variable over the second.
    fn slope(&self) -> f64 {
        if self.square[1] > 0.0 {
            self.product / self.square[1]
        } else {
            0.0
        }
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
pub fn median(values: Vec<f32>) -> Option<f32> {
    (!values.is_empty()).then(|| quantile(values, 0.5))
}

/// The value below which this share of some values lies.
fn quantile(mut values: Vec<f32>, share: f64) -> f32 {
    let at = (share * (values.len() - 1) as f64) as usize;
    *values.select_nth_unstable_by(at, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows along a line, with places and scales given by `at` and `size`.
    fn line(count: usize, at: impl Fn(usize) -> f32, size: impl Fn(usize) -> f32) -> Vec<Node> {
        let node = |i: usize| {
            let s = size(i);
            Node {
                mean: [at(i), 0.0, 0.0],
                cov: [s * s, 0.0, 0.0, s * s, 0.0, 0.01 * s * s],
                alpha: 0.2,
                ..Node::default()
            }
            .weighed()
        };
        (0..count).map(node).collect()
    }

    fn evenly(i: usize) -> f32 {
        i as f32 + 1.0
    }

    /// From 1 to 4,000, dense at the beginning.
    fn receding(i: usize) -> f32 {
        (i as f32 / 60.0).exp()
    }

    fn scattered(i: usize) -> f32 {
        0.01 * ((i * 7919 % 500) as f32 / 60.0).exp()
    }

    fn measured(nodes: &[Node]) -> Importance {
        let rows: Vec<_> = nodes.iter().map(|&node| node.into()).collect();
        Importance::of_scene(&rows)
    }

    #[test]
    fn one_size_counts_by_area_and_a_spread_nearly_by_number() {
        let exponent = |nodes: &[Node]| measured(nodes).exponent;
        assert_eq!(exponent(&line(500, evenly, |_| 0.1)), 1.0);
        assert_eq!(exponent(&line(500, evenly, scattered)), LEAST);
        let half = line(500, evenly, |i| {
            0.01 * ((i * 7919 % 500) as f32 / 192.0).exp()
        });
        assert!((0.4..0.8).contains(&exponent(&half)), "{}", exponent(&half));
    }

    #[test]
    fn sizes_that_grow_with_the_distance_count_as_they_look() {
        let nodes = line(500, receding, |i| 0.01 * receding(i));
        let by = measured(&nodes);
        assert_eq!((by.exponent, by.angular), (LEAST, 1.0));
        let (near, far) = (by.of(&nodes[200]), by.of(&nodes[499]));
        assert!((0.5..2.0).contains(&(near / far)), "{near} {far}");
        assert!(nodes[499].mass > 1e4 * nodes[200].mass);
        let slowly = line(500, receding, |i| 0.01 * receding(i).sqrt());
        let by = measured(&slowly);
        assert_eq!((by.exponent, by.angular), (1.0, 0.0));
        assert_eq!(by.of(&slowly[499]), slowly[499].mass);
        let falling = line(500, receding, |i| 0.01 / receding(i));
        let by = measured(&falling);
        assert_eq!((by.exponent, by.angular), (LEAST, 0.0));
    }

    #[test]
    fn sizes_follow_the_distance_whatever_the_opacities() {
        let of = |faint: f32| {
            let mut nodes = line(500, receding, |i| 0.01 * receding(i));
            for (i, node) in nodes.iter_mut().enumerate() {
                node.alpha = if i % 2 == 0 { 0.9 } else { faint };
                *node = node.weighed();
            }
            measured(&nodes).angular
        };
        assert_eq!(of(0.9), 1.0);
        assert_eq!(of(0.000_1), 1.0);
    }

    #[test]
    fn people_stand_near_what_is_small_whatever_share_is_sky() {
        for sky in [10, 50, 65] {
            for far in [30.0, 3e3, 3e6] {
                let is_sky = |i: usize| i % 100 < sky;
                let at = |i: usize| 1e-3 * i as f32;
                let size = |i: usize| if is_sky(i) { 0.1 * far } else { 0.01 };
                let mut nodes = line(1000, at, size);
                for (i, node) in nodes.iter_mut().enumerate().filter(|(i, _)| is_sky(*i)) {
                    // On half a dome: all turns, all heights.
                    let (turn, height) = (2.4 * i as f32, i as f32 / 1000.0);
                    let across = far * (1.0 - height * height).sqrt();
                    node.mean = [across * turn.cos(), across * turn.sin(), far * height];
                }
                let by = measured(&nodes);
                assert!(
                    by.place[0] < 1.0 && by.place[2] == 0.0,
                    "{sky} {far}: {by:?}"
                );
                assert_eq!(by.angular, 1.0, "{sky} {far}");
                let (distant, near) = (by.of(&nodes[0]), by.of(&nodes[99]));
                assert!(distant < 200.0 * near, "{sky} {far}: {distant} {near}");
            }
        }
    }

    #[test]
    fn the_place_survives_a_change_of_units() {
        let by = measured(&line(500, receding, |i| 0.01 * receding(i)));
        let (origin, unit) = ([3.0, -5.0, 0.5], 0.25);
        let there = by.in_scene(origin, unit);
        assert_eq!(there.reach, by.reach * unit);
        assert_eq!(there.in_units(origin, unit), by);
    }

    #[test]
    fn moments_are_those_of_pairs() {
        let pairs = [(1.0, 2.0), (2.0, 4.5), (3.0, 5.5), (4.0, 9.0), (5.0, 7.0)];
        let moments = Moments::of(pairs.into_iter());
        assert!((moments.deviation() - 2f64.sqrt()).abs() < 1e-12);
        assert!((moments.correlation() - 14.5 / (10.0 * 27.7f64).sqrt()).abs() < 1e-12);
        assert!((moments.slope() - 14.5 / 27.7).abs() < 1e-12);
    }

    #[test]
    fn a_row_of_median_mass_weighs_what_its_opacity_says() {
        let nodes = line(501, evenly, |i| {
            0.01 * ((i * 7919 % 501) as f32 / 60.0).exp()
        });
        let by = measured(&nodes);
        let usual = |n: &&Node| f64::from(n.mass) == by.usual;
        let node = nodes.iter().find(usual).expect("the median is a row's");
        let times = f64::from(by.of(node)) / by.usual;
        assert!((times - 0.2f64.powf(FAINT * (1.0 - LEAST))).abs() < 1e-6);
        assert_eq!(Importance::default().of(&nodes[3]), nodes[3].mass);
    }

    #[test]
    fn one_row_and_coinciding_rows_have_a_finite_weight() {
        for nodes in [line(1, evenly, |_| 0.1), line(9, |_| 1.0, |_| 0.1)] {
            let by = measured(&nodes);
            assert!(by.of(&nodes[0]) > 0.0 && by.of(&nodes[0]).is_finite());
        }
        assert_eq!(measured(&[]), Importance::default());
    }

    #[test]
    fn a_spread_of_sizes_as_they_look_counts_nearly_by_number() {
        let by = measured(&line(500, receding, |i| scattered(i) * receding(i)));
        assert_eq!((by.exponent, by.angular), (LEAST, 1.0));
    }

    #[test]
    fn distances_where_people_walk_about_do_not_tell_how_sizes_grow() {
        // A fifth lies ever closer to the origin, all of one size; beyond, sizes grow with the distance.
        let at = |i: usize| (i as f32 - 100.0) / if i < 100 { 8.0 } else { 60.0 };
        let nodes = line(500, |i| at(i).exp(), |i| 0.01 * at(i).max(0.0).exp());
        assert_eq!(measured(&nodes).angular, 1.0);
    }

    #[test]
    fn people_do_not_stand_where_a_few_rows_coincide() {
        let at = |i: usize| if i % 20 == 7 { 1500.0 } else { evenly(i) };
        let by = measured(&line(500, at, |_| 0.1));
        assert!(by.place[0] <= 500.0, "{by:?}");
    }
}
