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
    /// Estimates Σ αT² without views; lengths in those of the scene.
    pub importance: Importance,
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
            let (weight, mass) = leaves.sums();
            leaves.floor = floor(weight, mass);
        }
        leaves
    }

    /// Σ αT² over the views, and apparent mass, of all rows.
    pub fn sums(&self) -> (f64, f64) {
        let masses: Vec<f32> = (0..self.len())
            .into_par_iter()
            .map(|i| self.apparent_mass(&self.without_areas(i)))
            .collect();
        let mass: f64 = masses.iter().map(|&m| f64::from(m)).sum();
        let weight = |v| self.kept.iter().map(move |&i| self.weight(v, i));
        let total = self
            .visibility
            .map_or(0.0, |v| weight(v).map(f64::from).sum());
        (total, mass)
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
                self.weight(visibility, self.kept[i]) + self.floor * self.apparent_mass(&node)
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

/// Σ αT² that a unit of apparent mass counts for though no view sees it.
pub fn floor(weight: f64, mass: f64) -> f32 {
    UNSEEN
        * if weight > 0.0 && mass > 0.0 {
            (weight / mass).min(f64::from(f32::MAX)) as f32
        } else {
            1.0
        }
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
            let pixel_size = [0.01; ROWS];
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
                for i in 0..ROWS {
                    alike(weights[i], weight[i] + floor * looks[i]);
                }
            }
            let (of_tile, ..) = weighed(100, seen, Some(&frame));
            for i in 100..ROWS {
                alike(of_tile[i], weights[i]);
            }
        }
    }
}
