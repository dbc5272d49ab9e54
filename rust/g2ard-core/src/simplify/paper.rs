//! The paper's policy: drop, merge cell × colour bin under guards, trim to the budget.

use rayon::prelude::*;

use super::moments::{Merged, optical_mass, sigmoid};
use super::protection::color;
use super::trim::best;
use super::{GONE, GroupKernels, Outcome, Step};
use crate::constants::constants;
use crate::scene::{Ordered, SceneRef};
use crate::{Control, Error, Result, Splats};

constants! {
    /// Defaults are the paper's (`tab:s_config`) but `support` and `flag_members`, which it does not state.
    pub struct Paper {
        /// Below this α a Gaussian is dropped.
        pub min_opacity: f64 = 0.01,
        /// Edge of the colour bins, which part [0, 1].
        pub color_bin: f64 = 0.25,
        /// Largest affine energy of a merged group, in-sample as E_j of eq. `frequency`.
        pub max_energy: f64 = 0.01,
        /// Least share of the members' footprint that the merged one covers.
        pub min_coverage: f64 = 0.6,
        /// End of a footprint, in standard deviations: see [`super::coverage`].
        pub support: f64 = 3.0,
        /// ε_h: a cell of higher affine residual is protected.
        pub flag_threshold: f64 = 0.01,
        /// A cell with fewer members borrows those of its face neighbours for the fit; two for each of the four affine
        /// coefficients.
        pub flag_members: usize = 8,
        /// λ_h of π.
        pub protection: f64 = 10.0,
    }
}

/// Counts to reach, and about how many cells each round divides the scene into: one for every Gaussian of the final
/// budget.
#[derive(Debug, Clone, Copy)]
pub struct PaperPlan<'a> {
    pub schedule: &'a [usize],
    pub cells: usize,
}

/// Counts of one round, in rows unless stated otherwise.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PaperRound {
    pub before: usize,
    pub dropped: usize,
    pub cells: usize,
    /// Rows alone in their cell and colour bin: no group to examine.
    pub alone: usize,
    pub merged_groups: usize,
    pub merged_members: usize,
    /// Groups rejected by each guard; energy is tested first.
    pub refused_energy: usize,
    pub refused_coverage: usize,
    /// Merges taken back because they would have undershot the budget.
    pub undone_groups: usize,
    /// Merged groups whose α was clipped.
    pub clamped_opacities: usize,
    pub trimmed: usize,
    pub after: usize,
}

/// Targets of a round.
#[derive(Clone, Copy)]
struct Target {
    budget: usize,
    cells: usize,
    /// New means are rounded to multiples of this.
    grid: f64,
}

struct Candidate {
    merged: Merged,
    cost: f64,
}

impl Paper {
    /// Run the rounds of a plan. Without `protected` they are computed first, on the raw scene over its cells.
    pub fn run(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        protected: Option<&[bool]>,
        plan: PaperPlan,
        kernels: &dyn GroupKernels,
        control: &Control,
    ) -> Result<Outcome<PaperRound>> {
        let mut step = Step::start(ordered.splats(scene));
        let mut protected = match protected {
            Some(flags) => {
                Error::unless_equal("protected", flags.len(), ordered.rows.len(), "rows")?;
                ordered.sorted(flags)
            }
            None => super::protection_flags(&step.splats, plan.cells, self, kernels, control)?,
        };
        let mut rounds = Vec::new();
        let shed = |budget: usize| ordered.rows.len().saturating_sub(budget) as u64;
        control.begin(shed(plan.schedule.last().copied().unwrap_or(usize::MAX)));
        for &budget in plan.schedule {
            let target = Target {
                budget,
                cells: plan.cells,
                grid: ordered.grid,
            };
            let (next, report) = self.round(&step.splats, &protected, target, kernels, control)?;
            protected = next.inherited(&protected);
            control.advance((report.before - report.after) as u64);
            kernels.rows_replaced();
            step = step.then(next);
            rounds.push(report);
        }
        Ok(step.finish(scene, ordered, protected, rounds))
    }

    /// Run one round to exactly the budget, or keep all rows if there are no more.
    fn round(
        &self,
        splats: &Splats,
        protected: &[bool],
        target: Target,
        kernels: &dyn GroupKernels,
        control: &Control,
    ) -> Result<(Step, PaperRound)> {
        let budget = target.budget;
        let mut report = PaperRound {
            before: splats.len(),
            after: splats.len().min(budget),
            ..PaperRound::default()
        };
        let kept = self.drop_transparent(splats, protected, budget);
        report.dropped = splats.len() - kept.len();
        let groups = if kept.len() > budget {
            self.groups(splats, &kept, target.cells, kernels, &mut report)?
        } else {
            kept.iter().map(|&i| vec![i]).collect()
        };
        let mut merges = self.judge(splats, &groups, kernels, &mut report, control)?;
        undo_costliest(&groups, &mut merges, budget, &mut report);
        let built = build(splats, &groups, merges, target.grid, &mut report);
        Ok((self.trim(built, protected, budget, &mut report), report))
    }

    fn priority(&self, splats: &Splats, protected: &[bool]) -> Vec<f64> {
        let score = |i: usize| {
            let logit = f64::from(splats.logit_opacities[i]);
            let mass = optical_mass(logit, splats.scales[i].map(f64::from));
            mass * (1.0 + self.protection * f64::from(u8::from(protected[i])))
        };
        (0..splats.len()).into_par_iter().map(score).collect()
    }

    /// Rows with α ≥ α_min; if they are fewer than the budget, the best of the others too.
    fn drop_transparent(&self, splats: &Splats, protected: &[bool], budget: usize) -> Vec<u32> {
        let visible =
            |i: u32| sigmoid(f64::from(splats.logit_opacities[i as usize])) >= self.min_opacity;
        let kept: Vec<u32> = (0..splats.len() as u32).filter(|&i| visible(i)).collect();
        if kept.len() >= budget.min(splats.len()) {
            return kept;
        }
        let mut scores = self.priority(splats, protected);
        kept.iter()
            .for_each(|&i| scores[i as usize] = f64::INFINITY);
        best(&scores, budget)
    }

    /// Rows that share a cell and a colour bin; groups in order of their first row.
    fn groups(
        &self,
        splats: &Splats,
        kept: &[u32],
        target: usize,
        kernels: &dyn GroupKernels,
        report: &mut PaperRound,
    ) -> Result<Vec<Vec<u32>>> {
        let cells = kernels.cells(splats, kept, target)?;
        report.cells = cells.len();
        let ids: Vec<usize> = (0..cells.len()).collect();
        let mut groups: Vec<Vec<u32>> = ids
            .par_iter()
            .flat_map_iter(|&c| {
                let mut keyed: Vec<([i32; 3], u32)> = cells
                    .members_of(c)
                    .iter()
                    .map(|&at| {
                        (
                            self.bin(color(splats, kept[at as usize] as usize)),
                            kept[at as usize],
                        )
                    })
                    .collect();
                keyed.sort_unstable();
                let runs = keyed.chunk_by(|a, b| a.0 == b.0);
                runs.map(|run| run.iter().map(|m| m.1).collect())
                    .collect::<Vec<Vec<u32>>>()
            })
            .collect();
        groups.par_sort_unstable_by_key(|g| g[0]);
        report.alone = groups.iter().filter(|g| g.len() == 1).count();
        Ok(groups)
    }

    /// The last bin is closed: 1 is in it.
    fn bin(&self, color: [f64; 3]) -> [i32; 3] {
        let last = (1.0 / self.color_bin).ceil() as i32 - 1;
        color.map(|c| ((c / self.color_bin) as i32).min(last))
    }

    /// Each group's merged Gaussian if both guards pass; energy is tested first.
    fn judge(
        &self,
        splats: &Splats,
        groups: &[Vec<u32>],
        kernels: &dyn GroupKernels,
        report: &mut PaperRound,
        control: &Control,
    ) -> Result<Vec<Option<Box<Candidate>>>> {
        let several: Vec<usize> = (0..groups.len()).filter(|&g| groups[g].len() > 1).collect();
        let group = |at: usize, rows: &mut Vec<u32>| {
            rows.extend_from_slice(&groups[several[at]]);
            rows.len()
        };
        let energies = kernels.energies(splats, several.len(), &group, control)?;
        let examined = several.len();
        let smooth: Vec<(usize, f64)> = several
            .into_iter()
            .zip(energies)
            .filter(|&(_, energy)| energy <= self.max_energy)
            .collect();
        report.refused_energy = examined - smooth.len();
        let candidates: Vec<&[u32]> = smooth.iter().map(|&(g, _)| &groups[g][..]).collect();
        let merges = kernels.merges(splats, &candidates, self.support, control)?;
        let mut accepted: Vec<_> = groups.iter().map(|_| None).collect();
        for (&(g, energy), (merged, covered)) in smooth.iter().zip(merges) {
            if covered < self.min_coverage {
                report.refused_coverage += 1;
                continue;
            }
            let cost = merged.mass * (energy + 1.0 - covered);
            accepted[g] = Some(Box::new(Candidate { merged, cost }));
        }
        Ok(accepted)
    }

    /// Keep the rows of highest priority down to the budget; `protected` are the flags of the round's input.
    fn trim(
        &self,
        built: Step,
        protected: &[bool],
        budget: usize,
        report: &mut PaperRound,
    ) -> Step {
        let n = built.splats.len();
        if n <= budget {
            return built;
        }
        report.trimmed = n - budget;
        let protected = built.inherited(protected);
        let stay = best(&self.priority(&built.splats, &protected), budget);
        let mut to = vec![GONE; n];
        stay.iter()
            .enumerate()
            .for_each(|(out, &row)| to[row as usize] = out as u32);
        let trimmed = Step {
            splats: take(&built.splats, &stay),
            parents: to,
            ..Step::default()
        };
        built.then(trimmed)
    }
}

/// Takes merges back, the costliest first (the later between equals), until `budget` is reached again.
fn undo_costliest(
    groups: &[Vec<u32>],
    merges: &mut [Option<Box<Candidate>>],
    budget: usize,
    report: &mut PaperRound,
) {
    let size = |g: usize, merges: &[Option<Box<Candidate>>]| {
        if merges[g].is_some() {
            1
        } else {
            groups[g].len()
        }
    };
    let mut count: usize = (0..groups.len()).map(|g| size(g, merges)).sum();
    if count >= budget {
        return;
    }
    let mut order: Vec<(f64, usize)> = (0..groups.len())
        .filter_map(|g| merges[g].as_ref().map(|m| (m.cost, g)))
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    while count < budget
        && let Some((_, g)) = order.pop()
    {
        merges[g] = None;
        count += groups[g].len() - 1;
        report.undone_groups += 1;
    }
}

/// The groups' rows in order: one for a merged group, else its members.
fn build(
    splats: &Splats,
    groups: &[Vec<u32>],
    merges: Vec<Option<Box<Candidate>>>,
    grid: f64,
    report: &mut PaperRound,
) -> Step {
    let mut out = Step {
        parents: vec![GONE; splats.len()],
        ..Step::default()
    };
    out.splats.sh_coeffs = splats.sh_coeffs;
    for (rows, candidate) in groups.iter().zip(merges) {
        if let Some(candidate) = candidate {
            report.merged_groups += 1;
            report.merged_members += rows.len();
            out.clamped += usize::from(candidate.merged.clamped);
            let to = out.splats.len() as u32;
            rows.iter().for_each(|&i| out.parents[i as usize] = to);
            push_merged(&mut out.splats, candidate.merged, grid);
            continue;
        }
        for &i in rows {
            out.parents[i as usize] = out.splats.len() as u32;
            push_copy(&mut out.splats, splats, i as usize);
        }
    }
    report.clamped_opacities = out.clamped;
    out
}

fn push_merged(out: &mut Splats, merged: Merged, grid: f64) {
    out.means
        .push(merged.gaussian.mean.map(|v| (v / grid).round() * grid));
    out.quats.push(merged.gaussian.quat());
    out.scales.push(merged.gaussian.stored_scales());
    out.logit_opacities.push(merged.logit as f32);
    out.sh.extend(merged.sh);
}

fn push_copy(out: &mut Splats, splats: &Splats, i: usize) {
    out.means.push(splats.means[i]);
    out.quats.push(splats.quats[i]);
    out.scales.push(splats.scales[i]);
    out.logit_opacities.push(splats.logit_opacities[i]);
    out.sh.extend_from_slice(splats.sh_of(i));
}

fn take(splats: &Splats, rows: &[u32]) -> Splats {
    let mut out = Splats {
        sh_coeffs: splats.sh_coeffs,
        ..Splats::default()
    };
    rows.iter()
        .for_each(|&i| push_copy(&mut out, splats, i as usize));
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;
    use crate::scene::Means;
    use crate::simplify::merge;
    use crate::{Cpu, linalg};

    /// Rows at random places; every fourth hardly visible.
    fn splats(count: usize) -> Splats {
        let mut random = Lcg(31);
        let mut next = || random.centred();
        Splats {
            means: (0..count)
                .map(|_| [next(), next(), 0.01 * next()])
                .collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            scales: (0..count)
                .map(|_| [0.05 + 0.04 * next() as f32, 0.05, 0.002])
                .collect(),
            logit_opacities: (0..count)
                .map(|i| if i % 4 == 0 { -6.0 } else { next() as f32 })
                .collect(),
            sh: (0..count).map(|_| [0.5 * next() as f32; 3]).collect(),
            sh_coeffs: 1,
        }
    }

    #[test]
    fn the_fewest_and_costliest_merges_are_undone() {
        let splats = splats(13);
        let groups = [
            vec![0, 1, 2, 3, 4],
            vec![5, 6, 7, 8],
            vec![9, 10, 11],
            vec![12],
        ];
        let costs = [1.0, 9.0, 5.0];
        for (budget, undone) in [
            (1, 0),
            (4, 0),
            (5, 1),
            (7, 1),
            (8, 2),
            (9, 2),
            (10, 3),
            (13, 3),
        ] {
            let mut merges: Vec<_> = groups
                .iter()
                .zip(costs)
                .map(|(rows, cost)| {
                    let merged = merge(&splats, rows);
                    Some(Box::new(Candidate { merged, cost }))
                })
                .chain([None])
                .collect();
            let mut report = PaperRound::default();
            undo_costliest(&groups, &mut merges, budget, &mut report);
            assert_eq!(report.undone_groups, undone, "{budget}");
            let left: Vec<usize> = (0..3).filter(|&g| merges[g].is_some()).collect();
            assert_eq!(
                left,
                [[0, 1, 2].as_slice(), &[0, 2], &[0], &[]][undone],
                "{budget}"
            );
        }
    }

    #[test]
    fn the_counts_of_rounds_add_up() {
        let rows = splats(400);
        let scene = SceneRef {
            means: Means::F64(&rows.means),
            quats: &rows.quats,
            scales: &rows.scales,
            logit_opacities: &rows.logit_opacities,
            sh0: &rows.sh,
            sh_rest: &[],
            rest: 0,
        };
        let ordered = Ordered::new(&scene).unwrap();
        let plan = PaperPlan {
            schedule: &[290, 200, 60],
            cells: 60,
        };
        let (policy, control) = (Paper::default(), Control::default());
        let out = policy
            .run(&scene, &ordered, None, plan, &Cpu, &control)
            .unwrap();
        let mut before = 400;
        for (round, (r, &after)) in out.rounds.iter().zip(plan.schedule).enumerate() {
            assert_eq!((r.before, r.after), (before, after));
            assert_eq!(r.dropped, if round == 0 { 100 } else { 0 });
            let merged = r.merged_members - r.merged_groups;
            assert_eq!(before - r.dropped - merged - r.trimmed, after, "{r:?}");
            before = after;
        }
        assert!(out.rounds.iter().any(|r| r.merged_groups > 0));
        assert_eq!(out.parents.iter().filter(|&&p| p < 0).count(), {
            let gone = out.rounds.iter().map(|r| r.dropped).sum::<usize>();
            let gone_later = out.parents.iter().filter(|&&p| p < 0).count();
            assert!(gone_later >= gone);
            gone_later
        });
    }

    #[test]
    fn optical_mass_is_depth_times_area() {
        for alpha in [0.01, 0.5, 0.9, 0.999] {
            let logit = f64::ln(alpha / (1.0 - alpha));
            let depth = -f64::ln(1.0 - alpha.min(0.99));
            for scales in [[2.0, 3.0, 0.1], [0.1, 2.0, 3.0], [3.0, 0.1, 2.0]] {
                let got = optical_mass(logit, scales);
                assert!((got - 6.0 * depth).abs() < 1e-9, "{alpha}: {got}");
            }
        }
    }

    #[test]
    fn coverage_is_the_covered_share_of_tilted_and_stretched_members() {
        use crate::scene::Gaussian;
        use crate::simplify::coverage;
        let mut random = Lcg(32);
        let mut next = || random.centred();
        let (mut off, mut partly) = (0.0, 0);
        for _ in 0..300 {
            // In one plane, so that a member's shadow is its own ellipse.
            let turned = |angle: f64, mean: [f64; 3], scales: [f64; 3]| Gaussian {
                mean,
                rotation: linalg::rotation_from_quat([
                    (angle / 2.0).cos(),
                    0.0,
                    0.0,
                    (angle / 2.0).sin(),
                ]),
                scales,
            };
            let merged = turned(3.0 * next(), [0.0; 3], [1.5, 1.0, 0.01]);
            let shift = [9.0 * next(), 9.0 * next(), 0.0];
            let member = turned(6.0 * next(), shift, [0.9 + next(), 0.3, 0.01]);
            let axis = |g: &Gaussian, k: usize| g.axis(k);
            let inside = (0..4000).filter(|i| {
                let (r, a) = ((f64::from(*i) / 4000.0).sqrt(), 2.399_963 * f64::from(*i));
                let along = [
                    3.0 * r * a.cos() * member.scales[0],
                    3.0 * r * a.sin() * member.scales[1],
                ];
                let point = [0, 1, 2].map(|k| {
                    shift[k] + along[0] * axis(&member, 0)[k] + along[1] * axis(&member, 1)[k]
                });
                let u = linalg::dot(point, axis(&merged, 0)) / (3.0 * merged.scales[0]);
                let v = linalg::dot(point, axis(&merged, 1)) / (3.0 * merged.scales[1]);
                u * u + v * v <= 1.0
            });
            let want = inside.count() as f64 / 4000.0;
            let got = coverage(&[member], &merged, 3.0);
            off += (got - want).abs();
            partly += i32::from(want > 0.05 && want < 0.95);
            assert!((got - want).abs() < 0.16, "{got} {want}");
        }
        assert!(partly > 40 && off < 300.0 * 0.03, "{partly} {off}");
    }
}
