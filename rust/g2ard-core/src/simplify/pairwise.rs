//! The pairwise policy, which users know as `default` and `fast`: runs of Morton order first, then pairs of
//! neighbours, cheapest first, in rounds that lock what they merge.
//!
//! The rounds only decide *which* rows go together, in f32 and in units of the scene's typical size; what
//! comes out is made in f64 from the raw members of each cluster ([`Partition::assemble`]).

use rayon::prelude::*;

use super::clusters::{Pair, Partition};
use super::cost::Weights;
use super::importance::median;
use super::leaves::{Leaves, Visibility};
use super::matching::{Nodes, candidates, matched};
use super::moments::sigmoid;
use super::morton_tree::{cut, merge_costs};
use super::rows::{Rows, Shuffled};
use super::trim::best;
use super::{GONE, Outcome, Step, surface};
use crate::constants::constants;
use crate::scene::{Ordered, SceneRef};
use crate::{Control, Error, Result, Splats};

constants! {
    /// The constants, named as in Python, which takes its defaults from here. They are what measured best
    /// (decisions 0005 to 0009).
    pub struct Pairwise {
        /// Below this α a Gaussian is dropped: no renderer draws it.
        pub min_opacity: f64 = 0.004,
        /// Down to this many times the budget, rows merge along Morton order alone; infinite for never.
        pub morton_premerge_ratio: f64 = 3.0,
        /// Number of merging steps, each on a shifted lattice; every step except the first halves the count.
        pub morton_premerge_steps: usize = 1,
        /// Rows of the longest run along Morton order, in mean runs.
        pub longest_run: f64 = 6.0,
        /// Nearest clusters that one may merge with.
        pub neighbors: usize = 6,
        /// Weight of the geometric error beside that of colour; without views [`Self::BLIND`] of it.
        pub geometric_weight: f64 = 0.03,
        /// Weight of the error of gradients beside that of values, in pixels squared. Only with views: without, no
        /// pixel is known.
        pub edge_weight: f64 = 0.5,
        /// Standard deviation of the blur that renderers add, in pixels.
        pub dilation: f64 = 0.4,
        /// Without views: size of a pixel over the median largest scale.
        pub pixel_scale: f64 = 0.2,
        /// Optical depth at a merged Gaussian up to which it widens, where α alone cannot hold its mass.
        pub surface_depth: f64 = 3.0,
        /// Largest growth of its area.
        pub max_growth: f64 = f64::INFINITY,
    }
}

/// Counts of one round, in rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PairwiseRound {
    pub before: usize,
    pub dropped: usize,
    pub merged: usize,
    pub after: usize,
}

impl PairwiseRound {
    fn merging(before: usize, after: usize) -> Self {
        Self {
            before,
            merged: before - after,
            after,
            ..Self::default()
        }
    }
}

impl Pairwise {
    /// Share of the geometric weight without views, because much of the geometry is then hidden.
    pub const BLIND: f64 = 0.5;

    /// Along Morton order down to the budget, on two lattices: no graph of neighbours.
    pub fn fast() -> Self {
        Self {
            morton_premerge_ratio: 1.0,
            morton_premerge_steps: 2,
            longest_run: 4.0,
            ..Self::default()
        }
    }

    /// Rounds down to each count of `schedule`. `visibility` and `protected` have a row for each of the input's.
    pub fn run(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        visibility: Option<Visibility>,
        protected: Option<&[bool]>,
        schedule: &[usize],
        control: &Control,
    ) -> Result<Outcome<PairwiseRound>> {
        self.check(scene, visibility, protected)?;
        let protected = protected.map_or_else(|| vec![false; scene.len()], |f| ordered.sorted(f));
        let blur = self.blurs(scene, ordered, visibility, None);
        let budget = schedule.last().copied().unwrap_or(scene.len());
        control.begin(scene.len().saturating_sub(budget) as u64);
        let (mut partition, dropped) = self.drop_transparent(scene, ordered, budget);
        control.advance(dropped as u64);
        let leaves = Leaves::new(scene, ordered, partition.kept(), &blur, visibility, None);
        let mut runs = RunMerging {
            weights: self.weights(visibility),
            longest_run: self.longest_run,
            width: 0,
            partition: &mut partition,
            rounds: Vec::new(),
            control,
        };
        let mut nodes = self.premerge(leaves, budget, &mut runs)?;
        let (weights, mut rounds) = (runs.weights, runs.rounds);
        self.merge_rounds(&mut nodes, weights, schedule, control, |pairs, map| {
            let of = partition.of.par_iter_mut().filter(|c| **c != GONE);
            of.for_each(|c| *c = map[*c as usize]);
            let before = map.len();
            rounds.push(PairwiseRound::merging(before, before - pairs.len()));
        })?;
        if rounds.is_empty() && dropped > 0 {
            rounds.push(PairwiseRound::merging(nodes.len(), nodes.len()));
        }
        if let Some(first) = rounds.first_mut() {
            first.before += dropped;
            first.dropped = dropped;
        }
        partition.count = nodes.len();
        drop(nodes);
        let step = self.assembled(&partition, scene, ordered, &blur, control)?;
        let protected = step.inherited(&protected);
        Ok(step.finish(scene, ordered, protected, rounds))
    }

    /// The Gaussians of a partition, widened where a surface would show gaps.
    pub(super) fn assembled(
        &self,
        partition: &Partition,
        scene: &SceneRef,
        ordered: &Ordered,
        blur: &[f32],
        control: &Control,
    ) -> Result<Step> {
        let widened = |splats: &mut Splats, needed: &[f64]| {
            surface::close(splats, needed, self.surface_depth, self.max_growth, control)
        };
        partition.assemble(scene, ordered, blur, widened, control)
    }

    /// Merge the cheapest pairs of neighbours in rounds, down to each count of `schedule`. After a round `on_pairs`
    /// gets its pairs and the new index of every node that there was; two nodes that merged share one.
    pub(super) fn merge_rounds(
        &self,
        nodes: &mut Nodes,
        weights: Weights,
        schedule: &[usize],
        control: &Control,
        mut on_pairs: impl FnMut(&[Pair], &[u32]),
    ) -> Result<()> {
        for &target in schedule {
            // Costs are finite, so the cheapest candidate of all matches, and each turn merges at least one pair.
            while nodes.len() > target {
                let lists = candidates(nodes, self.neighbors, weights, control)?;
                let pairs = matched(&lists, self.neighbors, nodes.len() - target);
                drop(lists);
                if pairs.is_empty() {
                    return Err(Error::Stuck(
                        "simplify: no two of the Gaussians have neighbours",
                    ));
                }
                let new_index = merge(nodes, &pairs);
                on_pairs(&pairs, &new_index);
                control.advance(pairs.len() as u64);
            }
        }
        Ok(())
    }

    /// Merge runs of Morton order down to `morton_premerge_ratio` times the budget. The lattice is shifted in each
    /// step, so that one step can join what another cut apart.
    fn premerge(&self, leaves: Leaves, budget: usize, runs: &mut RunMerging) -> Result<Nodes> {
        let last = (self.morton_premerge_ratio * budget as f64).min(leaves.len() as f64) as usize;
        let band_0 = 3; // all that merging along Morton order compares
        runs.width = if last > budget {
            leaves.width()
        } else {
            band_0
        };
        let mut targets = (0..self.morton_premerge_steps)
            .rev()
            .map(|step| (step, last.saturating_mul(1 << step.min(32))))
            .filter(|&(_, target)| target < leaves.len());
        let Some((step, target)) = targets.next() else {
            return Ok(leaves.nodes());
        };
        let (mut rows, mut codes) = runs.merge(&leaves, &leaves.codes(), target, step)?;
        for (step, target) in targets {
            (rows, codes) = runs.merge(&rows, &codes, target, step)?;
        }
        Ok(rows.settled())
    }

    /// The weights of a cost's parts, in the kernels' precision.
    pub(super) fn weights(&self, visibility: Option<Visibility>) -> Weights {
        if visibility.is_none() {
            return Weights {
                geometric: (self.geometric_weight * Self::BLIND) as f32,
                edge: 0.0,
            };
        }
        // A node knows the size of its pixel by its blur, which is none in antialiased scenes.
        let blur = self.dilation * self.dilation;
        Weights {
            geometric: self.geometric_weight as f32,
            edge: if blur > 0.0 {
                (self.edge_weight / blur) as f32
            } else {
                0.0
            },
        }
    }

    pub(super) fn check(
        &self,
        scene: &SceneRef,
        visibility: Option<Visibility>,
        protected: Option<&[bool]>,
    ) -> Result<()> {
        let lengths = [
            ("visibility.weight", visibility.map(|v| v.weight.len())),
            (
                "visibility.pixel_size",
                visibility.map(|v| v.pixel_size.len()),
            ),
            ("protected", protected.map(<[bool]>::len)),
        ];
        for (name, rows) in lengths {
            if let Some(rows) = rows.filter(|&rows| rows != scene.len()) {
                return Err(Error::invalid(name, format!("{} rows", scene.len()), rows));
            }
        }
        refuse!(self.neighbors == 0 => "neighbors", "at least 1", 0);
        for (name, value) in [
            ("morton_premerge_ratio", self.morton_premerge_ratio),
            ("longest_run", self.longest_run),
            ("max_growth", self.max_growth),
        ] {
            refuse!(value.is_nan() || value < 1.0 => name, "at least 1", value);
        }
        let depth = self.surface_depth;
        refuse!(depth.is_nan() || depth <= 0.0 => "surface_depth", "above 0", depth);
        Ok(())
    }

    /// The variance that rendering adds to each ordered row. `usual` is the pixel size of rows that no view sees;
    /// `None` takes the scene's median.
    pub(super) fn blurs(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        visibility: Option<Visibility>,
        usual: Option<f32>,
    ) -> Vec<f32> {
        let pixel = visibility.map_or_else(Vec::new, |v| ordered.sorted(v.pixel_size));
        let finite = pixel.iter().copied().filter(|p| p.is_finite() && *p > 0.0);
        let usual = usual
            .or_else(|| median(finite.collect()))
            .unwrap_or_else(|| self.pixel_without_views(scene));
        let of = |i: usize| {
            let p = pixel
                .get(i)
                .copied()
                .filter(|p| p.is_finite() && *p > 0.0)
                .unwrap_or(usual);
            let e = self.dilation * f64::from(p);
            (e * e).min(f64::from(f32::MAX)) as f32
        };
        (0..scene.len()).into_par_iter().map(of).collect()
    }

    /// The size of a pixel where there are no views.
    pub(super) fn pixel_without_views(&self, scene: &SceneRef) -> f32 {
        let largest = scene.scales.iter().map(|s| s[0].max(s[1]).max(s[2]));
        self.pixel_scale as f32 * median(largest.collect()).unwrap_or(1.0)
    }

    /// Make every visible row a cluster; if there are fewer than the budget, also the most opaque of the others.
    pub(super) fn drop_transparent(
        &self,
        scene: &SceneRef,
        ordered: &Ordered,
        budget: usize,
    ) -> (Partition, usize) {
        let opacity = |&row: &u32| sigmoid(f64::from(scene.logit(row as usize)));
        let mut scores: Vec<f64> = ordered.rows.par_iter().map(opacity).collect();
        scores
            .par_iter_mut()
            .filter(|a| **a >= self.min_opacity)
            .for_each(|a| *a = 1.0);
        let visible = scores.iter().filter(|a| **a == 1.0).count();
        let keep = best(&scores, visible.max(budget.min(scores.len())));
        let mut of = vec![GONE; scores.len()];
        keep.iter()
            .enumerate()
            .for_each(|(c, &i)| of[i as usize] = c as u32);
        let count = keep.len();
        (Partition { of, count }, scores.len() - count)
    }
}

/// Merging along Morton order, and its effect on the partition.
struct RunMerging<'a> {
    weights: Weights,
    longest_run: f64,
    /// Values of SH that the nodes keep.
    width: usize,
    partition: &'a mut Partition,
    rounds: Vec<PairwiseRound>,
    control: &'a Control,
}

impl RunMerging<'_> {
    /// The `target` runs of rows that are cheapest to merge become nodes. Returns them in Morton order on the lattice
    /// of this step, and their codes.
    fn merge(
        &mut self,
        rows: &impl Rows,
        codes: &[u64],
        target: usize,
        step: usize,
    ) -> Result<(Shuffled, Vec<u64>)> {
        self.control.check()?;
        let longest = longest(self.longest_run, rows.len() as f64 / target as f64);
        let costs = merge_costs(codes, rows, self.weights, longest);
        let third = ((rows.len() - target.min(rows.len())) / 3) as u64;
        self.control.advance(third);
        self.control.check()?;
        let runs = cut(&costs, target);
        drop(costs);
        self.rounds
            .push(PairwiseRound::merging(rows.len(), runs.count));
        let nodes = rows.merged(&runs, self.width);
        self.control.advance(third);
        self.control.check()?;
        let every: Vec<u32> = (0..nodes.len() as u32).collect();
        let (at, map, codes) = nodes.morton(&every, LATTICES[step % LATTICES.len()]);
        let of = self.partition.of.par_iter_mut().filter(|c| **c != GONE);
        of.for_each(|c| *c = map[runs.of[*c as usize] as usize]);
        self.control
            .advance((rows.len() - runs.count) as u64 - 2 * third);
        Ok((Shuffled { nodes, at }, codes))
    }
}

/// The most rows of a run, at least a pair.
pub(super) fn longest(longest_run: f64, mean_run: f64) -> usize {
    (longest_run * mean_run).max(2.0) as usize
}

/// Merge the pairs and put the remaining nodes in Morton order. Return the new index of every node.
fn merge(nodes: &mut Nodes, pairs: &[Pair]) -> Vec<u32> {
    let width = nodes.width;
    let mut into = vec![GONE; nodes.len()];
    for &Pair { a, b, .. } in pairs {
        let (x, y) = (nodes.geometry[a as usize], nodes.geometry[b as usize]);
        nodes.geometry[a as usize] = x.merged(&y);
        let share = x.share(&y);
        let (low, high) = nodes.sh.split_at_mut(b as usize * width);
        let own = &mut low[a as usize * width..(a as usize + 1) * width];
        own.iter_mut()
            .zip(&high[..width])
            .for_each(|(p, q)| *p += share * (q - *p));
        into[b as usize] = a;
    }
    let left: Vec<u32> = (0..nodes.len() as u32)
        .filter(|&i| into[i as usize] == GONE)
        .collect();
    let (from, mut map, _) = nodes.morton(&left, [0.0; 3]);
    nodes.gather(&from);
    for i in 0..into.len() {
        if into[i] != GONE {
            map[i] = map[into[i] as usize];
        }
    }
    map
}

/// Shifts of the Morton lattice per step, along x, y and z, as shares of the bounds' radius: incommensurable, so that
/// no plane that separates cells in one step does so in the next.
const LATTICES: [[f64; 3]; 3] = [[0.0; 3], [0.31, 0.17, 0.43], [0.13, 0.41, 0.23]];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;
    use crate::scene::Means;
    use crate::simplify::cost::Node;
    use crate::simplify::{Frame, Tile};

    const ROWS: usize = 40;
    const KEPT: usize = 3;

    /// Every magnitude of f32: nothing, the least, subnormal, ordinary and the largest numbers.
    const MAGNITUDES: [f32; 12] = [
        0.0,
        1e-45,
        1e-38,
        1e-24,
        9.4e-14, // e^-30
        1e-6,
        1.0,
        1e6,
        1e11,
        1e19,
        1e30,
        f32::MAX,
    ];

    /// Gaussians of size `scale`, but every third of size `other`, spread over a cube of half-width `spread`.
    struct Scene {
        means: Vec<[f32; 3]>,
        scales: Vec<[f32; 3]>,
        quats: Vec<[f32; 4]>,
        logits: Vec<f32>,
        sh0: Vec<[f32; 3]>,
    }

    impl Scene {
        fn new(scale: f32, other: f32, spread: f32) -> Self {
            let mut random = Lcg(17);
            let mut next = || 2.0 * random.centred() as f32;
            Self {
                means: (0..ROWS)
                    .map(|_| [spread * next(), spread * next(), spread * next()])
                    .collect(),
                scales: (0..ROWS)
                    .map(|i| {
                        [[scale, 0.5 * scale, 0.1 * scale], [other; 3]][usize::from(i % 3 == 2)]
                    })
                    .collect(),
                quats: (0..ROWS)
                    .map(|_| [next(), next(), next(), next()])
                    .collect(),
                logits: (0..ROWS).map(|_| 3.0 * next()).collect(),
                sh0: (0..ROWS).map(|_| [next(), next(), next()]).collect(),
            }
        }

        fn borrow(&self) -> SceneRef<'_> {
            SceneRef {
                means: Means::F32(&self.means),
                quats: &self.quats,
                scales: &self.scales,
                logit_opacities: &self.logits,
                sh0: &self.sh0,
                sh_rest: &[],
                rest: 0,
            }
        }
    }

    fn finite(node: &Node) -> bool {
        let Node {
            mean,
            cov,
            blur,
            alpha,
            mass,
            visibility,
            areas,
        } = node;
        let values = mean.iter().chain(cov).chain(areas);
        values
            .chain([blur, alpha, mass, visibility])
            .all(|v| v.is_finite())
    }

    /// Merges the scene whole and as a tile; checks the counts, and that everything on the way is finite.
    fn check(scene: &Scene, visibility: Option<Visibility>, what: &str) {
        let (scene, control) = (scene.borrow(), Control::default());
        let ordered = Ordered::new(&scene).unwrap();
        let policy = Pairwise::default();
        let blur = policy.blurs(&scene, &ordered, visibility, None);
        let rows = (0..ROWS as u32).collect();
        let mut nodes = Leaves::new(&scene, &ordered, rows, &blur, visibility, None).nodes();
        while nodes.len() > KEPT {
            assert!(nodes.geometry.iter().all(finite), "{what}");
            let lists = candidates(
                &nodes,
                policy.neighbors,
                policy.weights(visibility),
                &control,
            )
            .unwrap();
            let partners = lists.iter().filter(|c| c.1 != GONE);
            assert!(partners.clone().count() >= nodes.len(), "{what}");
            assert!(partners.clone().all(|c| c.0.is_finite() && c.0 >= 0.0));
            let pairs = matched(&lists, policy.neighbors, nodes.len() - KEPT);
            assert!(!pairs.is_empty(), "{what}");
            merge(&mut nodes, &pairs);
        }
        let sound = |splats: &crate::Splats| {
            let means = splats.means.as_flattened().iter().all(|v| v.is_finite());
            let quats = splats.quats.as_flattened().iter().all(|v| v.is_finite());
            let scales = splats.scales.as_flattened();
            let logits = splats.logit_opacities.iter().all(|v| v.is_finite());
            means && quats && logits && scales.iter().all(|v| v.is_finite() && *v >= 0.0)
        };
        for policy in [policy, Pairwise::fast()] {
            let schedule = [20, KEPT];
            let out = policy.run(&scene, &ordered, visibility, None, &schedule, &control);
            let out = out.unwrap().splats;
            assert_eq!(out.len(), KEPT, "{what}");
            assert!(sound(&out), "{what}: {out:?}");
        }
        let mut frame = Frame::of_sample(&policy, &scene, &ordered);
        let mut tile = Tile {
            policy,
            scene: &scene,
            ordered: &ordered,
            visibility,
            frame,
        };
        if visibility.is_some() {
            frame = frame.with_views(0.01, tile.sums().unwrap());
            tile.frame = frame;
        }
        let runs = 20;
        let costs = tile.run_costs(2.0).unwrap();
        let plan = tile.plan(runs, &[KEPT], &costs, &control).unwrap();
        assert_eq!(plan.merges.len(), runs - KEPT, "{what}");
        assert!(plan.merges.iter().all(|p| p.cost.is_finite()), "{what}");
    }

    #[test]
    fn sizes_and_spreads_of_any_magnitude_merge_to_the_count() {
        for scale in MAGNITUDES {
            for spread in MAGNITUDES {
                for other in [scale, 1.0] {
                    let scene = Scene::new(scale, other, spread);
                    check(&scene, None, &format!("{scale:e} {other:e} {spread:e}"));
                }
            }
        }
    }

    #[test]
    fn pixels_and_weights_of_any_magnitude_merge_to_the_count() {
        for scale in [0.0, 9.4e-14, 0.1, 1e19] {
            let scene = Scene::new(scale, scale, 1.0);
            for size in MAGNITUDES {
                for weight in MAGNITUDES {
                    let mut pixel_size = vec![size; ROWS];
                    pixel_size[..4].fill(f32::INFINITY);
                    pixel_size[4..6].fill(0.01);
                    let mut weights = vec![weight; ROWS];
                    weights[2..9].fill(1.0);
                    let seen = Visibility {
                        weight: &weights,
                        pixel_size: &pixel_size,
                    };
                    check(
                        &scene,
                        Some(seen),
                        &format!("{scale:e} {size:e} {weight:e}"),
                    );
                }
            }
        }
    }

    #[test]
    fn blurs_are_variances_of_a_share_of_the_pixel() {
        let scene = Scene::new(0.1, 0.3, 1.0);
        let scene = scene.borrow();
        let ordered = Ordered::new(&scene).unwrap();
        let policy = Pairwise::default();
        let mut pixel_size = vec![0.05; ROWS];
        pixel_size[7] = 2.0;
        pixel_size[8] = f32::INFINITY;
        let seen = Visibility {
            weight: &[1.0; ROWS],
            pixel_size: &pixel_size,
        };
        let variance = |pixel: f64| (policy.dilation * pixel).powi(2);
        let blur = policy.blurs(&scene, &ordered, Some(seen), None);
        for (&row, &got) in ordered.rows.iter().zip(&blur) {
            let want = variance(if row == 7 { 2.0 } else { 0.05 });
            assert!((f64::from(got) - want).abs() < 1e-6 * want, "{row}");
        }
        let unseen = policy.blurs(&scene, &ordered, None, None);
        let want = variance(policy.pixel_scale * 0.1);
        assert!(
            unseen
                .iter()
                .all(|&b| (f64::from(b) - want).abs() < 1e-5 * want)
        );
    }

    #[test]
    fn runs_merge_alike_in_any_place_in_memory() {
        let scene = Scene::new(0.1, 0.3, 1.0);
        let scene = scene.borrow();
        let ordered = Ordered::new(&scene).unwrap();
        let rows: Vec<u32> = (0..ROWS as u32).collect();
        let blur = [0.01; ROWS];
        let leaves = Leaves::new(&scene, &ordered, rows.clone(), &blur, None, None);
        let runs = Partition {
            of: rows.iter().map(|row| row / 4).collect(),
            count: ROWS / 4,
        };
        let want = leaves.merged(&runs, leaves.width());
        let mut nodes = leaves.nodes();
        nodes.gather(&rows.iter().rev().copied().collect::<Vec<_>>());
        let at = rows.iter().rev().copied().collect();
        let got = Shuffled { nodes, at }.merged(&runs, 3);
        assert_eq!(got.geometry, want.geometry);
        assert_eq!((got.sh, got.width), (want.sh, 3));
    }

    #[test]
    fn a_round_that_merges_nothing_is_an_error() {
        let lost = Node {
            mean: [f32::NAN; 3],
            ..Node::default()
        };
        let mut nodes = Nodes {
            geometry: vec![lost; 9],
            sh: vec![0.0; 27],
            width: 3,
        };
        let control = Control::default();
        let policy = Pairwise::default();
        let ended =
            policy.merge_rounds(&mut nodes, policy.weights(None), &[3], &control, |_, _| ());
        assert!(matches!(ended, Err(Error::Stuck(_))), "{ended:?}");
    }

    #[test]
    fn the_unit_moves_no_bit_of_a_cost() {
        let scene = Scene::new(0.1, 0.03, 1.0);
        let (scene, control) = (scene.borrow(), Control::default());
        let ordered = Ordered::new(&scene).unwrap();
        let policy = Pairwise::default();
        let seen = Visibility {
            weight: &[1.0; ROWS],
            pixel_size: &[0.01; ROWS],
        };
        let frame = Frame::of_sample(&policy, &scene, &ordered);
        let costs = |unit: f64| {
            let mut tile = Tile {
                policy,
                scene: &scene,
                ordered: &ordered,
                visibility: Some(seen),
                frame: Frame { unit, ..frame },
            };
            tile.frame = tile.frame.with_views(0.01, tile.sums().unwrap());
            let costs = tile.run_costs(2.0).unwrap();
            (tile.plan(30, &[5], &costs, &control).unwrap(), costs)
        };
        let usual = costs(frame.unit);
        for times in [1.0 / 1024.0, 0.5, 4096.0] {
            assert_eq!(costs(times * frame.unit), usual, "{times}");
        }
    }

    #[test]
    fn without_views_no_pixel_weighs_edges_and_geometry_weighs_half() {
        let policy = Pairwise::default();
        let seen = Visibility {
            weight: &[1.0; ROWS],
            pixel_size: &[0.01; ROWS],
        };
        let want = |geometric: f64, edge: f64| Weights {
            geometric: geometric as f32,
            edge: edge as f32,
        };
        assert_eq!(policy.weights(None), want(0.03 / 2.0, 0.0));
        assert_eq!(policy.weights(Some(seen)), want(0.03, 0.5 / (0.4 * 0.4)));
        let antialiased = Pairwise {
            dilation: 0.0,
            ..policy
        };
        assert_eq!(antialiased.weights(Some(seen)), want(0.03, 0.0));
    }

    #[test]
    fn the_longest_run_is_a_multiple_of_the_mean_and_at_least_a_pair() {
        assert_eq!(longest(6.0, 10.0), 60);
        assert_eq!(longest(1.0, 1.5), 2);
    }
}
