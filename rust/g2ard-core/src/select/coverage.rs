//! Greedy choice of views by how they cover the surface (the paper, eq. `view_selection`, algorithm `alg:s_avs`).

use rayon::prelude::*;

use super::Surface;
use super::lazy::{Chosen, Objective, lazy_greedy};
use crate::constants::constants;
use crate::linalg::{dot, sub};
use crate::{Control, Error, Result};

/// Most directions per cell.
const MAX_ANCHORS: usize = 64;
/// Cells summed together: the order of the sum does not depend on the number of threads.
const CHUNK: usize = 4096;

constants! {
    /// Options of the objective.
    pub struct Coverage {
        /// Sharpness of the observation kernel and of the targets.
        pub kappa: f64 = 20.0,
        /// Exponent of the fair utility u(x) = x^(1−α)/(1−α); 1 is the logarithm.
        pub alpha: f64 = 2.0,
        /// λ of g(x) = u(λ + x).
        pub offset: f64 = 1.0,
        /// Directions on the sphere that targets and observations are laid out on.
        pub anchors: usize = 32,
        /// ε of C_jk / (P_jk + ε): keeps the ratio finite where a target is almost zero.
        pub epsilon: f64 = 1e-9,
    }
}

impl Coverage {
    pub fn validate(&self) -> Result<()> {
        for (name, value, ok) in [
            ("kappa", self.kappa, self.kappa > 0.0),
            ("alpha", self.alpha, self.alpha >= 0.0),
            ("offset", self.offset, self.offset > 0.0),
            ("epsilon", self.epsilon, self.epsilon > 0.0),
        ] {
            refuse!(!(ok && value.is_finite()) => name, "a positive number", value);
        }
        refuse!(!(1..=MAX_ANCHORS).contains(&self.anchors) => "anchors", format!("1 to {MAX_ANCHORS}"), self.anchors);
        Ok(())
    }

    fn g(&self, x: f64) -> f64 {
        let x = self.offset + x;
        if self.alpha == 2.0 {
            -1.0 / x
        } else if self.alpha == 1.0 {
            x.ln()
        } else {
            x.powf(1.0 - self.alpha) / (1.0 - self.alpha)
        }
    }
}

/// Cells, who sees them, and from where.
#[derive(Debug, Clone, Copy)]
pub struct Problem<'a> {
    pub surface: &'a Surface,
    /// Each view's cells.
    pub visible: &'a [Vec<u32>],
    /// Each view's camera centre.
    pub positions: &'a [[f64; 3]],
}

impl Problem<'_> {
    /// The `k` views that greedy maximisation of F picks.
    pub fn greedy(&self, k: usize, coverage: &Coverage, control: &Control) -> Result<Chosen> {
        coverage.validate()?;
        let n = self.visible.len();
        Error::unless_equal("positions", self.positions.len(), n, "rows")?;
        let cells = self.surface.len() as u32;
        refuse!(self.visible.iter().flatten().any(|&c| c >= cells) =>
            "visible", format!("cells below {cells}"), "one beyond");
        lazy_greedy(State::new(*self, *coverage), k, control)
    }
}

struct State<'a> {
    problem: Problem<'a>,
    coverage: Coverage,
    anchors: Vec<[f64; 3]>,
    /// P_jk and C_jk, anchor by anchor within a cell.
    targets: Vec<f64>,
    evidence: Vec<f64>,
}

impl<'a> State<'a> {
    fn new(problem: Problem<'a>, coverage: Coverage) -> Self {
        let anchors = sphere(coverage.anchors);
        let targets: Vec<f64> = problem
            .surface
            .normals
            .par_iter()
            .flat_map_iter(|&n| target(&anchors, n, coverage.kappa))
            .collect();
        let evidence = vec![0.0; targets.len()];
        Self {
            problem,
            coverage,
            anchors,
            targets,
            evidence,
        }
    }

    /// Calls `f(index of (cell, anchor), ν·η·φ)` for all that `view` adds to a cell.
    fn observe(&self, view: usize, cell: u32, mut f: impl FnMut(usize, f64)) {
        let (j, count) = (cell as usize, self.anchors.len());
        let surface = self.problem.surface;
        let to = sub(self.problem.positions[view], surface.centers[j]);
        let length = dot(to, to).sqrt();
        if length == 0.0 {
            return;
        }
        let d = to.map(|v| v / length);
        let confidence = surface.confidence[j];
        let incidence = (1.0 - confidence) + confidence * dot(d, surface.normals[j]).abs();
        let kappa = self.coverage.kappa;
        let mut near = [(0usize, 0.0f64); MAX_ANCHORS];
        let (mut found, mut total, mut best) = (0, 0.0, (0, f64::NEG_INFINITY));
        for (k, &a) in self.anchors.iter().enumerate() {
            let away = dot(a, d) - 1.0;
            if away > best.1 {
                best = (k, away);
            }
            if away > -3.0 / kappa {
                let value = (kappa * away).exp();
                near[found] = (k, value);
                found += 1;
                total += value;
            }
        }
        if found == 0 {
            return f(j * count + best.0, incidence); // a kernel narrower than the anchors' spacing
        }
        for &(k, value) in &near[..found] {
            f(j * count + k, incidence * value / total);
        }
    }
}

impl Objective for State<'_> {
    fn views(&self) -> usize {
        self.problem.visible.len()
    }

    /// What adding a view would gain: Σ over its cells of weight · Σ p·(g(after) − g(before)).
    fn gain(&self, view: usize) -> f64 {
        let parts: Vec<f64> = self.problem.visible[view]
            .par_chunks(CHUNK)
            .map(|cells| {
                let mut sum = 0.0;
                for &cell in cells {
                    let mut own = 0.0;
                    self.observe(view, cell, |at, value| {
                        let p = self.targets[at];
                        let (before, scale) = (self.evidence[at], p + self.coverage.epsilon);
                        let g = |c: f64| self.coverage.g(c / scale);
                        own += p * (g(before + value) - g(before));
                    });
                    sum += self.problem.surface.weights[cell as usize] * own;
                }
                sum
            })
            .collect();
        parts.iter().sum()
    }

    /// Adds a view's observations to the evidence.
    fn add(&mut self, view: usize) {
        let mut changes = Vec::new();
        for &cell in &self.problem.visible[view] {
            self.observe(view, cell, |at, value| changes.push((at, value)));
        }
        for (at, value) in changes {
            self.evidence[at] += value;
        }
    }
}

/// P_k ∝ exp(κ |a_k·n|), summing to 1.
fn target(anchors: &[[f64; 3]], n: [f64; 3], kappa: f64) -> Vec<f64> {
    let raw: Vec<f64> = anchors
        .iter()
        .map(|&a| (kappa * (dot(a, n).abs() - 1.0)).exp())
        .collect();
    let total: f64 = raw.iter().sum();
    raw.into_iter().map(|v| v / total).collect()
}

/// `count` directions on the Fibonacci sphere.
fn sphere(count: usize) -> Vec<[f64; 3]> {
    let golden = (5.0f64.sqrt() - 1.0) / 2.0;
    (0..count)
        .map(|k| {
            let z = 1.0 - (2.0 * k as f64 + 1.0) / count as f64;
            let (turn, across) = (
                std::f64::consts::TAU * (k as f64 * golden).fract(),
                (1.0 - z * z).sqrt(),
            );
            [across * turn.cos(), across * turn.sin(), z]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_spread_evenly() {
        for count in [8, 32, 64] {
            let all = sphere(count);
            let mean = |k: usize| all.iter().map(|a| a[k]).sum::<f64>() / count as f64;
            assert!((0..3).all(|k| mean(k).abs() < 0.06), "{count}");
            let closest = 1.0 - 3.0 / count as f64; // of caps that would fill the sphere: 1 − 2/n
            for (i, a) in all.iter().enumerate() {
                assert!((dot(*a, *a) - 1.0).abs() < 1e-12);
                assert!(
                    all[..i].iter().all(|b| dot(*a, *b) < closest),
                    "{count} {i}"
                );
            }
        }
    }

    #[test]
    fn targets_are_shares_that_grow_with_the_angle_to_the_surface() {
        let anchors = sphere(16);
        for kappa in [0.0f64, 2.0, 40.0] {
            for n in sphere(5) {
                let shares = target(&anchors, n, kappa);
                assert!((shares.iter().sum::<f64>() - 1.0).abs() < 1e-12);
                for (a, share) in anchors.iter().zip(&shares) {
                    let ratio = (kappa * (dot(*a, n).abs() - dot(anchors[0], n).abs())).exp();
                    assert!((share / (ratio * shares[0]) - 1.0).abs() < 1e-9, "{kappa}");
                }
            }
        }
    }

    #[test]
    fn utilities_have_the_slope_that_their_exponent_says() {
        for alpha in [0.0, 0.5, 1.0, 2.0, 3.0] {
            let coverage = Coverage {
                alpha,
                ..Coverage::default()
            };
            for x in [0.0, 0.3, 4.0] {
                let slope = (coverage.g(x + 1e-5) - coverage.g(x)) / 1e-5;
                let want = (coverage.offset + x).powf(-alpha);
                assert!((slope - want).abs() < 1e-4, "{alpha} {x}: {slope} {want}");
            }
        }
    }

    #[test]
    fn a_gain_is_what_f_grows_by() {
        let surface = Surface {
            centers: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 1.0]],
            normals: vec![[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 1.0, 0.0]],
            confidence: vec![1.0, 0.3, 0.0],
            weights: vec![0.5, 0.3, 0.2],
            size: 0.1,
        };
        let positions = [[0.0, 0.0, 5.0], [4.0, 1.0, 1.0], [-1.0, -3.0, 2.0]];
        let visible = [vec![0, 1, 2], vec![1, 2], vec![0, 2]];
        let problem = Problem {
            surface: &surface,
            visible: &visible,
            positions: &positions,
        };
        let coverage = Coverage::default();
        let anchors = sphere(coverage.anchors);
        // C of every (cell, anchor): incidence spread over the anchors near the direction to the view.
        let evidence = |views: &[usize]| {
            let mut c = vec![[0.0; 32]; 3];
            for &view in views {
                for &cell in &visible[view] {
                    let j = cell as usize;
                    let to = sub(positions[view], surface.centers[j]);
                    let d = to.map(|v| v / dot(to, to).sqrt());
                    let trust = surface.confidence[j];
                    let incidence = 1.0 - trust + trust * dot(d, surface.normals[j]).abs();
                    let near = |a: [f64; 3]| {
                        let away = coverage.kappa * (dot(a, d) - 1.0);
                        if away > -3.0 { away.exp() } else { 0.0 }
                    };
                    let total: f64 = anchors.iter().map(|&a| near(a)).sum();
                    for (c, &a) in c[j].iter_mut().zip(&anchors) {
                        *c += incidence * near(a) / total;
                    }
                }
            }
            c
        };
        let value = |views: &[usize]| -> f64 {
            let c = evidence(views);
            let cell = |j: usize| {
                let p = target(&anchors, surface.normals[j], coverage.kappa);
                let own = p.iter().zip(&c[j]);
                surface.weights[j]
                    * own
                        .map(|(p, c)| p * coverage.g(c / (p + coverage.epsilon)))
                        .sum::<f64>()
            };
            (0..3).map(cell).sum()
        };
        let chosen = problem.greedy(3, &coverage, &Control::default()).unwrap();
        let (mut views, mut before) = (Vec::new(), value(&[]));
        for (&view, &gain) in chosen.views.iter().zip(&chosen.gains) {
            let others = (0..3).filter(|v| !views.contains(v));
            let best = others
                .map(|v| value(&[&views[..], &[v]].concat()))
                .fold(f64::MIN, f64::max);
            views.push(view as usize);
            let after = value(&views);
            assert!((after - before - gain).abs() < 1e-9, "{views:?}");
            assert!(after >= best - 1e-12);
            before = after;
        }
    }
}
