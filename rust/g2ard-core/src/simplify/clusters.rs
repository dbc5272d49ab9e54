//! Gaussians from a partition of the rows: each cluster's moments in f64, from its raw members.

use super::kernels::in_chunks;
use super::moments::{pool, rendered_area, sigmoid};
use super::{GONE, Step};
use crate::scene::limits::MAX_OPACITY;
use crate::scene::{Gaussian, Ordered, SceneRef};
use crate::{Control, Result, Splats};

/// Two rows that merge, the lower index first, and what that costs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    pub a: u32,
    pub b: u32,
    pub cost: f32,
}

/// The cluster of each ordered row, or [`GONE`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Partition {
    pub of: Vec<u32>,
    pub count: usize,
}

impl Partition {
    /// The rows that are not [`GONE`], ascending.
    pub fn kept(&self) -> Vec<u32> {
        let rows = 0..self.of.len() as u32;
        rows.filter(|&i| self.of[i as usize] != GONE).collect()
    }

    /// Members of cluster `c`, ascending: `rows[starts[c]..starts[c + 1]]`.
    fn members(&self) -> (Vec<u32>, Vec<u32>) {
        let mut starts = vec![0u32; self.count + 2];
        for &c in self.of.iter().filter(|&&c| c != GONE) {
            starts[c as usize + 2] += 1;
        }
        for c in 2..starts.len() {
            starts[c] += starts[c - 1];
        }
        let mut rows = vec![0; starts[self.count + 1] as usize];
        for (i, &c) in self.of.iter().enumerate().filter(|(_, c)| **c != GONE) {
            rows[starts[c as usize + 1] as usize] = i as u32;
            starts[c as usize + 1] += 1;
        }
        starts.pop();
        (starts, rows)
    }

    /// One Gaussian per cluster, in the order of the clusters; a cluster of one is a copy of its member.
    ///
    /// Mass is α·A as rendered, A with the row's dilation `blur` (a variance), and is conserved: α of a
    /// cluster is Σm / A. Where that passes 0.99, the cluster can grow instead along its two longer axes: `widened`
    /// is called with the Gaussians and the growth that each one's mass needs.
    pub fn assemble(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        blur: &[f32],
        widened: impl FnOnce(&mut Splats, &[f64]) -> Result<()>,
        control: &Control,
    ) -> Result<Step> {
        let (starts, rows) = self.members();
        let members = |c: usize| &rows[starts[c] as usize..starts[c + 1] as usize];
        let make = |c: usize| make(scene, ordered, members(c), blur);
        let made = in_chunks(self.count, control, make)?;
        let mut step = Step {
            splats: Splats {
                sh_coeffs: scene.rest + 1,
                ..Splats::default()
            },
            parents: self.of.clone(),
            ..Step::default()
        };
        let mut needed = Vec::with_capacity(self.count);
        step.splats.sh.reserve(self.count * (scene.rest + 1));
        for (c, made) in made.enumerate() {
            step.clamped += usize::from(made.clamped);
            step.splats.means.push(made.mean);
            step.splats.quats.push(made.quat);
            step.splats.scales.push(made.scales);
            step.splats.logit_opacities.push(made.logit);
            needed.push(made.needed);
            average_sh(
                scene,
                ordered,
                members(c),
                &made.weights,
                &mut step.splats.sh,
            );
        }
        widened(&mut step.splats, &needed)?;
        Ok(step)
    }
}

/// A cluster's Gaussian; its SH are written later, into the one array of all.
struct Made {
    mean: [f64; 3],
    quat: [f32; 4],
    scales: [f32; 3],
    logit: f32,
    /// Share of each member in the mass; empty for a copy.
    weights: Vec<f64>,
    clamped: bool,
    /// Growth of the area with which α ≤ 0.99 holds the mass.
    needed: f64,
}

/// Merges a cluster's `members`; parameters are those of [`Partition::assemble`].
fn make(scene: &SceneRef, ordered: &Ordered, members: &[u32], blur: &[f32]) -> Made {
    if let [only] = members {
        let row = ordered.rows[*only as usize] as usize;
        return Made {
            mean: ordered.gaussian(scene, row).mean,
            quat: scene.quats[row],
            scales: scene.scales[row],
            logit: scene.logit(row),
            weights: Vec::new(),
            clamped: false,
            needed: 1.0,
        };
    }
    let mut least_blur = f64::INFINITY;
    let mut parts: Vec<_> = members
        .iter()
        .map(|&i| {
            let row = ordered.rows[i as usize] as usize;
            let g = ordered.gaussian(scene, row);
            let (cov, blur) = (g.covariance(), f64::from(blur[i as usize]));
            least_blur = least_blur.min(blur);
            let alpha = sigmoid(f64::from(scene.logit(row))).min(MAX_OPACITY);
            (alpha * rendered_area(&cov, blur), g.mean, cov)
        })
        .collect();
    let mass: f64 = parts.iter().map(|p| p.0).sum();
    if mass <= 0.0 {
        parts.iter_mut().for_each(|p| p.0 = 1.0);
    }
    let (mean, cov) = pool(&parts);
    let alpha = mass / rendered_area(&cov, least_blur);
    let total: f64 = parts.iter().map(|p| p.0).sum();
    let gaussian = Gaussian::from_moments(mean, &cov);
    Made {
        mean: ordered.on_grid(mean),
        quat: gaussian.quat(),
        scales: gaussian.stored_scales(),
        logit: logit_of(alpha.min(MAX_OPACITY)),
        weights: parts.iter().map(|p| p.0 / total).collect(),
        clamped: alpha > MAX_OPACITY,
        needed: (alpha / MAX_OPACITY).max(1.0),
    }
}

fn logit_of(alpha: f64) -> f32 {
    (alpha / (1.0 - alpha)).max(f64::MIN_POSITIVE).ln() as f32
}

/// Appends a cluster's SH to `out`: the mean by `weights`, or without weights a copy of its only member's.
fn average_sh(
    scene: &SceneRef,
    ordered: &Ordered,
    members: &[u32],
    weights: &[f64],
    out: &mut Vec<[f32; 3]>,
) {
    let of = |i: u32| scene.sh_of(ordered.rows[i as usize] as usize);
    if weights.is_empty() {
        let (dc, rest) = of(members[0]);
        out.push(dc);
        out.extend_from_slice(rest);
        return;
    }
    let mut sums = [[0.0f64; 3]; 16];
    for (&i, w) in members.iter().zip(weights) {
        let (dc, rest) = of(i);
        for (sum, sh) in sums.iter_mut().zip(std::iter::once(&dc).chain(rest)) {
            for k in 0..3 {
                sum[k] += w * f64::from(sh[k]);
            }
        }
    }
    out.extend(sums[..=scene.rest].iter().map(|s| s.map(|v| v as f32)));
}
