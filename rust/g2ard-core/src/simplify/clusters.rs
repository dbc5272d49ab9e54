//! Gaussians from a partition of the rows: each cluster's moments in f64, from its raw members.

use rayon::prelude::*;

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
        let coeffs = scene.rest + 1;
        let mut sh = vec![[0.0; 3]; self.count * coeffs];
        let chunks = sh.par_chunks_mut(CHUNK * coeffs).enumerate();
        let made = chunks.map(|(chunk, sh)| {
            control.check()?;
            let clusters = sh.chunks_mut(coeffs).zip(chunk * CHUNK..);
            Ok(clusters
                .map(|(sh, c)| make(scene, ordered, members(c), blur, sh))
                .collect::<Vec<_>>())
        });
        let made = made.collect::<Result<Vec<_>>>()?;
        let mut step = Step {
            splats: Splats {
                sh,
                sh_coeffs: coeffs,
                ..Splats::default()
            },
            parents: self.of.clone(),
            ..Step::default()
        };
        let mut needed = Vec::with_capacity(self.count);
        for made in made.into_iter().flatten() {
            step.clamped += usize::from(made.clamped);
            step.splats.means.push(made.mean);
            step.splats.quats.push(made.quat);
            step.splats.scales.push(made.scales);
            step.splats.logit_opacities.push(made.logit);
            needed.push(made.needed);
        }
        widened(&mut step.splats, &needed)?;
        Ok(step)
    }
}

/// Clusters between two checks of the control.
const CHUNK: usize = 256;

/// A cluster's Gaussian, except its SH.
struct Made {
    mean: [f64; 3],
    quat: [f32; 4],
    scales: [f32; 3],
    logit: f32,
    clamped: bool,
    /// Growth of the area with which α ≤ 0.99 holds the mass.
    needed: f64,
}

/// Merges a cluster's `members`, and writes its SH into `sh`; other parameters are those of [`Partition::assemble`].
fn make(
    scene: &SceneRef,
    ordered: &Ordered,
    members: &[u32],
    blur: &[f32],
    sh: &mut [[f32; 3]],
) -> Made {
    let sh_of = |i: u32| scene.sh_of(ordered.rows[i as usize] as usize);
    if let [only] = members {
        let row = ordered.rows[*only as usize] as usize;
        let (dc, rest) = sh_of(*only);
        sh[0] = dc;
        sh[1..].copy_from_slice(rest);
        return Made {
            mean: ordered.gaussian(scene, row).mean,
            quat: scene.quats[row],
            scales: scene.scales[row],
            logit: scene.logit(row),
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
    let mut sums = [[0.0f64; 3]; 16];
    for (&i, (mass, ..)) in members.iter().zip(&parts) {
        let (dc, rest) = sh_of(i);
        let weight = mass / total;
        for (sum, sh) in sums.iter_mut().zip(std::iter::once(&dc).chain(rest)) {
            for k in 0..3 {
                sum[k] += weight * f64::from(sh[k]);
            }
        }
    }
    for (out, sum) in sh.iter_mut().zip(sums) {
        *out = sum.map(|v| v as f32);
    }
    let gaussian = Gaussian::from_moments(mean, &cov);
    Made {
        mean: ordered.on_grid(mean),
        quat: gaussian.quat(),
        scales: gaussian.stored_scales(),
        logit: logit_of(alpha.min(MAX_OPACITY)),
        clamped: alpha > MAX_OPACITY,
        needed: (alpha / MAX_OPACITY).max(1.0),
    }
}

fn logit_of(alpha: f64) -> f32 {
    (alpha / (1.0 - alpha)).max(f64::MIN_POSITIVE).ln() as f32
}
