//! Coloured points → surface-aligned discs (supplement, "Dense Prior Construction").

mod lines;

use rayon::prelude::*;

use crate::constants::constants;
use crate::linalg::{Eigen, Sym3, outer, quat_from_rotation, sub, symmetric_eigen};
use crate::spatial::{Neighbor, Tree};
use crate::{Control, Result};

constants! {
    /// Defaults are the paper's.
    pub struct LiftConfig {
        /// Nearest others that PCA takes in.
        pub neighbors: usize = 10,
        /// Tangential scale over the neighbourhood's standard deviation along that axis; the paper does not state it.
        pub spread: f64 = 0.94,
        /// Normal scale over the geometric mean of the tangential ones.
        pub normal_ratio: f64 = 0.1,
        /// Largest ratio of the two tangential scales.
        pub max_anisotropy: f64 = 4.0,
    }
}

impl LiftConfig {
    fn validate(&self) -> Result<()> {
        refuse!(self.neighbors < 3 => "neighbors", "at least 3", self.neighbors);
        for (name, value, least) in [
            ("spread", self.spread, 0.0),
            ("normal_ratio", self.normal_ratio, 0.0),
            ("max_anisotropy", self.max_anisotropy, 1.0),
        ] {
            refuse!(!(value.is_finite() && value >= least && value > 0.0) =>
                name, format!("a number above {least}"), value);
        }
        Ok(())
    }
}

/// The frame and size of each point's disc: axes 1 and 2 span the tangent plane, axis 3 is the normal.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Discs {
    /// wxyz, unit.
    pub quats: Vec<[f32; 4]>,
    /// Descending standard deviations.
    pub scales: Vec<[f32; 3]>,
}

/// Tangential standard deviations (descending) and orientation of one neighbourhood.
#[derive(Clone, Copy)]
struct Patch {
    sigmas: [f64; 2],
    quat: [f64; 4],
}

impl Patch {
    /// `quat_from_rotation` flips a left-handed normal; `discs` handles an extent of zero.
    fn of(e: &Eigen) -> Self {
        let [t1, t2, n] = e.vectors;
        Self {
            sigmas: [0, 1].map(|k| e.values[k].max(0.0).sqrt()),
            quat: quat_from_rotation(&[0, 1, 2].map(|r| [t1[r], t2[r], n[r]])),
        }
    }

    /// Returns whether the neighbourhood is nearly a line.
    fn narrow(&self) -> bool {
        self.sigmas[1] < lines::LINE * self.sigmas[0] && self.sigmas[0].is_finite()
    }

    fn tangential(&self, config: &LiftConfig) -> [f64; 2] {
        let [wide, narrow] = self.sigmas.map(|s| config.spread * s);
        [wide, narrow.max(wide / config.max_anisotropy)]
    }
}

/// Neighbours over `neighbors` whose sizes limit that of a disc. Strays must be fewer than a quarter of them.
const AROUND: usize = 16;
/// Patches in Morton order that share the window in which strays are first looked for.
const WINDOW: usize = 64;
/// Logarithm of the ratio of the quartiles of sizes among points of even density: the radius of the k nearest has a relative
/// deviation of 1/(2√k), here of k = 10.
const EVEN: f64 = 1.349 * 0.158;
/// Radius of the nearest points in the corner of a surface, a quarter of a plane, over that inside.
const CORNER: f64 = 2.0;

/// Rows between two checks of the control.
const CHUNK: usize = 4096;

/// `points`: centred near the origin, finite.
pub fn lift(points: &[[f64; 3]], config: &LiftConfig, control: &Control) -> Result<Discs> {
    config.validate()?;
    let tree = Tree::build(points);
    control.begin(points.len() as u64);
    let chunks: Vec<(Vec<Patch>, Vec<u32>)> = (0..points.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            control.check()?;
            let here = chunk * CHUNK..((chunk + 1) * CHUNK).min(points.len());
            let (mut patches, mut beside) = (Vec::with_capacity(here.len()), Vec::new());
            tree.nearest(here.clone(), config.neighbors, |at, near| {
                let patch = Patch::of(&extent(points, tree.rows()[at], near));
                if patch.narrow() {
                    beside.extend(near.iter().map(|n| n.1));
                }
                patches.push(patch);
            });
            control.advance(here.len() as u64);
            Ok((patches, beside))
        })
        .collect::<Result<_>>()?;
    let (patches, beside): (Vec<_>, Vec<_>) = chunks.into_iter().unzip();
    let mut patches = patches.concat();
    let lines = lines::find(tree.rows(), &patches, &beside);
    lines::widen(points, lines, &mut patches, config, control)?;
    shrink_strays(&tree, &mut patches, config);
    Ok(discs(&tree, &patches, config))
}

/// PCA of the point and its neighbours about their mean.
fn extent(points: &[[f64; 3]], row: u32, near: &[Neighbor<f64>]) -> Eigen {
    let here = points[row as usize];
    let share = 1.0 / (near.len() + 1) as f64;
    let offsets = || near.iter().map(|n| sub(points[n.1 as usize], here));
    let mut mean = [0.0; 3];
    for d in offsets() {
        for k in 0..3 {
            mean[k] += d[k] * share;
        }
    }
    let mut cov: Sym3 = [0.0; 6];
    for d in offsets().chain([[0.0; 3]]) {
        let o = outer(sub(d, mean));
        for k in 0..6 {
            cov[k] += o[k] * share;
        }
    }
    symmetric_eigen(&cov)
}

/// Shrinks patches that are far larger than those around them, which span the void between stray points, to `fence`.
fn shrink_strays(tree: &Tree, patches: &mut [Patch], config: &LiftConfig) {
    let (count, around) = (patches.len(), AROUND * config.neighbors);
    if count <= around {
        return;
    }
    let sizes: Vec<f64> = patches
        .iter()
        .map(|p| p.sigmas[0].max(p.sigmas[1]))
        .collect();
    let candidates: Vec<usize> = (0..count.div_ceil(WINDOW))
        .into_par_iter()
        .flat_map_iter(|window| {
            let here = window * WINDOW..((window + 1) * WINDOW).min(count);
            let first = (here.start + WINDOW / 2).saturating_sub(around / 2);
            let first = first.min(count - around);
            let limit = fence(sizes[first..first + around].to_vec());
            here.filter(|&at| sizes[at] > limit).collect::<Vec<_>>()
        })
        .collect();
    let mut at_row = vec![0u32; if candidates.is_empty() { 0 } else { count }];
    for at in 0..at_row.len() {
        at_row[tree.rows()[at] as usize] = at as u32;
    }
    let limits: Vec<f64> = candidates
        .par_iter()
        .map(|&at| {
            let mut limit = f64::INFINITY;
            tree.nearest(at..at + 1, around, |_, near| {
                let size = |n: &Neighbor<f64>| sizes[at_row[n.1 as usize] as usize];
                limit = fence(near.iter().map(size).collect());
            });
            limit
        })
        .collect();
    for (at, limit) in candidates.into_iter().zip(limits) {
        let share = (limit / sizes[at]).min(1.0);
        patches[at].sigmas = patches[at].sigmas.map(|s| share * s);
    }
}

/// Tukey's fence of the logarithms of sizes, Q3 + 1.5 (Q3 − Q1), past which they are outliers: with at least the spread of
/// even points, and room for corners. Infinity if most sizes are 0.
fn fence(mut sizes: Vec<f64>) -> f64 {
    sizes.sort_unstable_by(f64::total_cmp);
    let quartile = |part: usize| sizes[part * sizes.len() / 4].ln();
    let (first, third) = (quartile(1), quartile(3));
    if !(first.is_finite() && third.is_finite()) {
        return f64::INFINITY;
    }
    CORNER * (third + 1.5 * (third - first).max(EVEN)).exp()
}

/// Sizes in the order of the points. A patch without extent (all neighbours at one place) takes the median extent of
/// the nearest patches that have one, or 1 if none has.
fn discs(tree: &Tree, patches: &[Patch], config: &LiftConfig) -> Discs {
    let sized: Vec<usize> = (0..patches.len())
        .filter(|&at| patches[at].sigmas[0] > 0.0)
        .collect();
    let mut out = Discs {
        quats: vec![[0.0; 4]; patches.len()],
        scales: vec![[0.0; 3]; patches.len()],
    };
    for (at, &row) in tree.rows().iter().enumerate() {
        let [a, b] = if patches[at].sigmas[0] > 0.0 {
            patches[at].tangential(config)
        } else {
            [local_median(patches, &sized, at, config); 2]
        };
        out.quats[row as usize] = patches[at].quat.map(|v| v as f32);
        out.scales[row as usize] = [a, b, config.normal_ratio * (a * b).sqrt()].map(|v| v as f32);
    }
    out
}

/// Median width of those of the `neighbors` patches around `at` in Morton order that have an extent.
fn local_median(patches: &[Patch], sized: &[usize], at: usize, config: &LiftConfig) -> f64 {
    let (count, middle) = (config.neighbors, sized.partition_point(|&s| s < at));
    let window =
        &sized[middle.saturating_sub(count / 2)..(middle + count.div_ceil(2)).min(sized.len())];
    let mut sigmas: Vec<f64> = window.iter().map(|&s| patches[s].sigmas[0]).collect();
    sigmas.sort_by(f64::total_cmp);
    let median = sigmas.get(sigmas.len() / 2);
    median.map_or(1.0, |sigma| config.spread * sigma)
}
