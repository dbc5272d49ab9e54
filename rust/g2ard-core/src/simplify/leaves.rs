//! The scene's rows as leaves of merging: Gaussians made nodes as they are read.

use rayon::prelude::*;

use super::cost::{MAX_ALPHA, Node};
use super::importance::{Importance, median};
use super::matching::Nodes;
use super::moments::sigmoid;
use super::rows::Rows;
use crate::linalg::sub;
use crate::scene::{Ordered, SceneRef, power_of_two_below};

/// Gaussians that a few views do not see keep this share of their mass, because other views will see some of them.
const UNSEEN: f32 = 0.2;
/// Where small Gaussians carry the detail, the part of the mean Σ αT² that each gets by how visible it is, whatever its
/// size. Measured on seven scenes under a sky: twice as much gains .1 dB.
const EVEN: f64 = 0.5;
/// There, weights are raised to 1 less this: a trainer splits what looks large, so that its own views saw all Gaussians
/// nearly alike, and large weights in a few planned views say more about these views than about the scene.
const LEVELLED: f64 = 0.5;

/// Largest scale in units.
const MAX_SCALE: f64 = 1e6;
/// Largest coordinate, and deviation of the dilation, in units. A cost multiplies four lengths, each at most a few times
/// as large, so everything it forms is finite.
const MAX_LENGTH: f64 = (1 << 29) as f64;
/// Largest Σ αT² of a row: all 2³² rows together stay within f32.
const MAX_VISIBILITY: f32 = f32::MAX / (1u64 << 32) as f32;

/// Visibility of each input row.
#[derive(Debug, Clone, Copy)]
pub struct Visibility<'a> {
    /// Σ αT² over the pixels of the views.
    pub weight: &'a [f32],
    /// Size of a pixel at the row, scene units; infinite where no view shows it.
    pub pixel_size: &'a [f32],
}

/// Units that tiles share so that their costs compare.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Unit of lengths.
    pub unit: f64,
    /// Pixel size of rows that no view sees.
    pub pixel_size: f32,
    /// Σ αT² that a unit of apparent mass counts for though no view sees it.
    pub floor: f32,
    /// Σ αT² that a row counts for per Σ αT² of each of its pixels.
    pub even: f32,
    /// Estimates Σ αT² without views; lengths in those of the scene.
    pub importance: Importance,
}

/// Sums over rows, of which tiles add up theirs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Sums {
    /// Σ αT² over the views.
    pub weight: f64,
    /// Apparent mass.
    pub mass: f64,
    /// Σ αT² over the views, per pixel that a row covers where it is seen largest.
    pub per_pixel: f64,
}

impl Sums {
    /// Σ αT² that a unit of apparent mass counts for though no view sees it.
    pub fn floor(&self) -> f32 {
        UNSEEN * ratio(self.weight, self.mass).unwrap_or(1.0)
    }

    /// Σ αT² that a row counts for per Σ αT² of each of its pixels.
    ///
    /// A view weighs a Gaussian by its area. If views are spread evenly in the logarithm of the distance, from where
    /// it covers a pixel, each counts the same, whatever its size: what is small is looked at from nearby.
    pub fn even(&self, importance: &Importance) -> f32 {
        let share = EVEN * importance.small_carry_detail();
        share as f32 * ratio(self.weight, self.per_pixel).unwrap_or(0.0)
    }
}

/// Rows of the scene. At 13 million their nodes would take more than the scene itself.
pub struct Leaves<'a> {
    scene: &'a SceneRef<'a>,
    ordered: &'a Ordered,
    /// The ordered rows that are kept, ascending.
    pub kept: Vec<u32>,
    /// The variance that rendering adds to each ordered row.
    blur: &'a [f32],
    visibility: Option<Visibility<'a>>,
    /// Unit of the scene's lengths.
    unit: f64,
    /// Σ αT² that a unit of apparent mass counts for though no view sees it.
    floor: f32,
    /// Σ αT² that a row counts for per Σ αT² of each of its pixels.
    even: f32,
    /// Estimates Σ αT² without views; lengths in units, from the order's origin.
    importance: Importance,
}

impl<'a> Leaves<'a> {
    /// `frame`: what holds for a scene of which this is a tile; `None` finds it in the scene itself.
    pub fn new(
        scene: &'a SceneRef<'a>,
        ordered: &'a Ordered,
        kept: Vec<u32>,
        blur: &'a [f32],
        visibility: Option<Visibility<'a>>,
        frame: Option<&Frame>,
    ) -> Self {
        let unit = frame.map_or_else(|| unit(scene, ordered, blur), |f| f.unit);
        let mut leaves = Self {
            scene,
            ordered,
            kept,
            blur,
            visibility,
            unit,
            floor: frame.map_or(0.0, |f| f.floor),
            even: frame.map_or(0.0, |f| f.even),
            importance: frame.map_or_else(Importance::default, |f| {
                f.importance.in_units(ordered.bounds.origin, unit)
            }),
        };
        if frame.is_some() {
            return leaves;
        }
        let rows = (0..leaves.len()).into_par_iter();
        let measured = rows.map(|i| leaves.without_areas(i).into());
        leaves.importance = Importance::of_scene(&measured.collect::<Vec<_>>());
        if visibility.is_some() {
            let sums = leaves.sums();
            leaves.floor = sums.floor();
            leaves.even = sums.even(&leaves.importance);
        }
        leaves
    }

    /// Sums over all rows.
    pub fn sums(&self) -> Sums {
        let rows: Vec<Sums> = (0..self.len())
            .into_par_iter()
            .map(|i| self.sums_of(i))
            .collect();
        rows.iter().fold(Sums::default(), |all, row| Sums {
            weight: all.weight + row.weight,
            mass: all.mass + row.mass,
            per_pixel: all.per_pixel + row.per_pixel,
        })
    }

    fn sums_of(&self, i: usize) -> Sums {
        let node = self.without_areas(i);
        let seen = self.visibility.map(|v| {
            (
                self.weight(v, self.kept[i]),
                self.per_pixel(v, self.kept[i], &node),
            )
        });
        let (weight, per_pixel) = seen.unwrap_or_default();
        Sums {
            weight: weight.into(),
            mass: self.apparent_mass(&node).into(),
            per_pixel: per_pixel.into(),
        }
    }

    /// The weight of rows without views, as computed by [`Self::new`], with lengths in those of the scene.
    pub fn importance(&self) -> Importance {
        self.importance
            .in_scene(self.ordered.bounds.origin, self.unit)
    }

    fn apparent_mass(&self, node: &Node) -> f32 {
        self.importance.apparent(node.mean, node.mass)
    }

    /// Their Morton codes, ascending.
    pub fn codes(&self) -> Vec<u64> {
        let codes = self.ordered.codes(self.scene);
        self.kept.iter().map(|&i| codes[i as usize]).collect()
    }

    /// Every row as a separate node.
    pub fn nodes(&self) -> Nodes {
        let width = self.width();
        let mut sh = vec![0.0; self.len() * width];
        let rows = sh.par_chunks_mut(width).enumerate();
        rows.for_each(|(i, out)| self.read_sh(i, out));
        Nodes {
            geometry: (0..self.len())
                .into_par_iter()
                .map(|i| self.node(i))
                .collect(),
            sh,
            width,
        }
    }

    /// A row's node, except its areas and its visibility.
    fn without_areas(&self, i: usize) -> Node {
        let at = self.kept[i] as usize;
        let row = self.ordered.rows[at] as usize;
        let mut g = self.ordered.gaussian(self.scene, row);
        g.scales = g.scales.map(|s| (s / self.unit).min(MAX_SCALE));
        let coordinate = |v: f64| (v / self.unit).clamp(-MAX_LENGTH, MAX_LENGTH) as f32;
        let blur = f64::from(self.blur[at]) / (self.unit * self.unit);
        let mut node = Node {
            mean: g.mean.map(coordinate),
            cov: g.covariance().map(|v| v as f32),
            blur: blur.min(MAX_LENGTH * MAX_LENGTH) as f32,
            alpha: (sigmoid(f64::from(self.scene.logit(row))) as f32).min(MAX_ALPHA),
            ..Node::default()
        };
        node.mass = node.mass_of();
        node
    }

    fn weight(&self, visibility: Visibility, ordered: u32) -> f32 {
        visibility.weight[self.ordered.rows[ordered as usize] as usize].max(0.0)
    }

    /// Brings a weight closer to the others'. Costs are linear in weights, so that their unit does not matter.
    fn level(&self, weight: f32) -> f32 {
        let less = LEVELLED * self.importance.small_carry_detail();
        if less == 0.0 {
            return weight;
        }
        f64::from(weight).powf(1.0 - less) as f32
    }

    /// A row's Σ αT² over the pixels that it covers where it is seen largest.
    fn per_pixel(&self, visibility: Visibility, ordered: u32, node: &Node) -> f32 {
        let pixel = visibility.pixel_size[self.ordered.rows[ordered as usize] as usize];
        let side = f64::from(pixel) / self.unit;
        let area = f64::from(node.mass) / f64::from(node.alpha);
        if !(side.is_finite() && area > 0.0) {
            return 0.0;
        }
        let weight = f64::from(self.weight(visibility, ordered));
        (weight * (side * side / area)).min(f64::from(MAX_VISIBILITY)) as f32
    }
}

impl Rows for Leaves<'_> {
    fn len(&self) -> usize {
        self.kept.len()
    }

    fn width(&self) -> usize {
        3 * (self.scene.rest + 1)
    }

    fn node(&self, i: usize) -> Node {
        let mut node = self.without_areas(i);
        node.areas = node.areas_of();
        let visibility = match self.visibility {
            Some(visibility) => {
                let at = self.kept[i];
                let weight = self.weight(visibility, at)
                    + self.floor * self.apparent_mass(&node)
                    + self.even * self.per_pixel(visibility, at, &node);
                self.level(weight)
            }
            None => self.importance.of(&node),
        };
        node.visibility = visibility.min(MAX_VISIBILITY);
        node
    }

    fn color(&self, i: usize) -> [f32; 3] {
        self.scene.sh0[self.ordered.rows[self.kept[i] as usize] as usize]
    }

    fn read_sh(&self, i: usize, out: &mut [f32]) {
        let (dc, rest) = self
            .scene
            .sh_of(self.ordered.rows[self.kept[i] as usize] as usize);
        let (band_0, higher) = out.split_at_mut(3);
        band_0.copy_from_slice(&dc);
        higher.copy_from_slice(&rest.as_flattened()[..higher.len()]);
    }
}

/// a / b within f32; `None` where either is 0.
fn ratio(a: f64, b: f64) -> Option<f32> {
    (a > 0.0 && b > 0.0).then(|| (a / b).min(f64::from(f32::MAX)) as f32)
}

/// The unit of lengths, a power of two so that dividing by it is exact: the typical size, or more where a scene or a
/// pixel is more than `MAX_LENGTH` times as large.
pub fn unit(scene: &SceneRef, ordered: &Ordered, blur: &[f32]) -> f64 {
    let far = |&row: &u32| {
        let from = sub(scene.means.get(row as usize), ordered.bounds.origin);
        from.iter().fold(0.0, |far: f64, v| far.max(v.abs()))
    };
    let extent = ordered.rows.par_iter().map(far).reduce(|| 0.0, f64::max);
    let widest = blur.iter().fold(0.0f32, |a, &b| a.max(b));
    let least = extent.max(f64::from(widest).sqrt()) / MAX_LENGTH;
    typical_size(scene).max(2.0 * power_of_two_below(least))
}

/// A power of two near the median of the middle scale.
fn typical_size(scene: &SceneRef) -> f64 {
    let middle = |s: &[f32; 3]| s[0].max(s[1]).min(s[2]).max(s[0].min(s[1]));
    let positive = scene
        .scales
        .iter()
        .map(middle)
        .filter(|s| *s > 0.0)
        .collect();
    power_of_two_below(f64::from(median(positive).unwrap_or(1.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Means;

    const ROWS: usize = 300;

    #[test]
    fn unseen_rows_weigh_a_share_of_how_large_they_look_in_the_whole_and_in_a_tile() {
        // Sizes grow with the distance from where people stand.
        let at = |i: usize| (i as f32 / 40.0).exp();
        let means: Vec<[f32; 3]> = (0..ROWS).map(|i| [at(i), 0.0, 0.0]).collect();
        let scales: Vec<[f32; 3]> = (0..ROWS).map(|i| [0.02 * at(i); 3]).collect();
        let scene = |rows: usize| SceneRef {
            means: Means::F32(&means[rows..]),
            quats: &[[1.0, 0.0, 0.0, 0.0]; ROWS][rows..],
            scales: &scales[rows..],
            logit_opacities: &[0.5; ROWS][rows..],
            sh0: &means[rows..],
            sh_rest: &[],
            rest: 0,
        };
        let weight: Vec<f32> = (0..ROWS).map(|i| (i % 3) as f32).collect();
        // Rows from `first` on: the Σ αT² of each, by input row.
        let weighed = |first: usize, seen: bool, frame: Option<&Frame>| {
            let scene = scene(first);
            let ordered = Ordered::new(&scene).unwrap();
            // Rows without a size in pixels count by what views see of them alone.
            let pixel_size = [f32::INFINITY; ROWS];
            let visibility = seen.then_some(Visibility {
                weight: &weight[first..],
                pixel_size: &pixel_size[first..],
            });
            let (blur, every) = ([1e-5; ROWS], (0..scene.len() as u32).collect());
            let leaves = Leaves::new(&scene, &ordered, every, &blur, visibility, frame);
            let (mut weights, mut looks) = (vec![0.0; ROWS], vec![0.0; ROWS]);
            for (i, &row) in ordered.rows.iter().enumerate() {
                let node = leaves.node(i);
                weights[first + row as usize] = node.visibility;
                looks[first + row as usize] = leaves.importance.apparent(node.mean, node.mass);
            }
            let frame = Frame {
                unit: leaves.unit,
                pixel_size: 0.01,
                floor: leaves.floor,
                even: leaves.even,
                importance: leaves.importance(),
            };
            (weights, looks, frame)
        };
        let alike =
            |got: f32, want: f32| assert!((got - want).abs() <= 1e-3 * want, "{got} {want}");
        for seen in [true, false] {
            let (weights, looks, frame) = weighed(0, seen, None);
            assert_eq!(frame.importance.angular, 1.0);
            if seen {
                let floor = UNSEEN * weight.iter().sum::<f32>() / looks.iter().sum::<f32>();
                let power = 1.0 - LEVELLED * frame.importance.small_carry_detail();
                for i in 0..ROWS {
                    let sum = f64::from(weight[i] + floor * looks[i]);
                    alike(weights[i], sum.powf(power) as f32);
                }
            }
            let (of_tile, ..) = weighed(100, seen, Some(&frame));
            for i in 100..ROWS {
                alike(of_tile[i], weights[i]);
            }
        }
    }

    #[test]
    fn where_small_rows_carry_the_detail_each_gets_a_part_by_how_visible_it_is() {
        // Seen from the origin, sizes grow with the distance and spread by a factor of 70 besides.
        let at = |i: usize| (i as f32 / 40.0).exp();
        let spread = |i: usize| ((i * 7919 % ROWS) as f32 / 70.0).exp();
        let means: Vec<[f32; 3]> = (0..ROWS).map(|i| [at(i), 0.0, 0.0]).collect();
        let scales: Vec<[f32; 3]> = (0..ROWS).map(|i| [1e-3 * at(i) * spread(i); 3]).collect();
        let scene = SceneRef {
            means: Means::F32(&means),
            quats: &[[1.0, 0.0, 0.0, 0.0]; ROWS],
            scales: &scales,
            logit_opacities: &[0.5; ROWS],
            sh0: &means,
            sh_rest: &[],
            rest: 0,
        };
        let ordered = Ordered::new(&scene).unwrap();
        // A view from the origin, in which the last row is hidden.
        let pixel_size: Vec<f32> = (0..ROWS).map(|i| 1e-3 * at(i)).collect();
        let mut weight: Vec<f32> = (0..ROWS).map(|i| spread(i) * spread(i)).collect();
        weight[ROWS - 1] = 0.0;
        let visibility = Visibility {
            weight: &weight,
            pixel_size: &pixel_size,
        };
        let (blur, every) = ([0.0; ROWS], (0..ROWS as u32).collect());
        let leaves = Leaves::new(&scene, &ordered, every, &blur, Some(visibility), None);
        assert!(leaves.importance.small_carry_detail() > 0.5);
        let power = 1.0 - LEVELLED * leaves.importance.small_carry_detail();
        let part = |i: usize| {
            let node = leaves.node(i);
            let unseen = leaves.floor * leaves.apparent_mass(&node);
            f64::from(node.visibility).powf(1.0 / power) as f32
                - weight[ordered.rows[i] as usize]
                - unseen
        };
        let sums = leaves.sums();
        let share = (EVEN * leaves.importance.small_carry_detail()) as f32;
        let each = share * sums.weight as f32 / (ROWS - 1) as f32;
        for i in 0..ROWS {
            let hidden = ordered.rows[i] as usize == ROWS - 1;
            let want = if hidden { 0.0 } else { each };
            assert!(
                (part(i) - want).abs() < 1e-2 * each,
                "{i}: {} {want}",
                part(i)
            );
        }
    }
}
