//! Wall time of each kernel on synthetic scenes: `make bench-kernels`, or `cargo bench -p g2ard-core -- raster` for some.
//!
//! Only the kernel is timed: scenes, views and what one kernel needs of another are made before.

mod scene;

use divan::{Bencher, Divan, black_box};
use g2ard_core::random::Lcg;
use g2ard_core::raster::{
    Accumulated, Camera, Image, ImageGradients, Params, Rasterizer, Settings,
};
use g2ard_core::{Control, Cpu};
use rayon::prelude::*;
use scene::{Scene, Slopes, cameras};

const COUNTS: [usize; 2] = [20_000, 200_000];
/// Ten times fewer.
const RATIO: usize = 10;
const WIDTH: usize = 640;
const HEIGHT: usize = 480;

fn main() {
    Divan::default()
        .sample_count(15)
        .max_time(std::time::Duration::from_secs(4))
        .config_with_args()
        .main();
}

mod spatial {
    use super::*;
    use g2ard_core::spatial::{RobustBounds, Tree, codes, order};

    const NEIGHBORS: usize = 6;

    #[divan::bench(args = COUNTS)]
    fn morton_order(bencher: Bencher, count: usize) {
        let points = Scene::of(count).means;
        bencher.bench(|| order(&codes(&points, &RobustBounds::of(&points))));
    }

    #[divan::bench(args = COUNTS)]
    fn tree_of_neighbors(bencher: Bencher, count: usize) {
        let points = Scene::of(count).means;
        bencher.bench(|| Tree::build(&points));
    }

    #[divan::bench(args = COUNTS)]
    fn six_nearest_of_all(bencher: Bencher, count: usize) {
        let tree = Tree::build(&Scene::of(count).means);
        bencher.bench(|| {
            (0..count.div_ceil(1024)).into_par_iter().for_each(|chunk| {
                let range = chunk * 1024..count.min((chunk + 1) * 1024);
                tree.nearest(range, NEIGHBORS, |_, found| {
                    black_box(found);
                });
            });
        });
    }
}

mod simplify {
    use super::*;
    use g2ard_core::scene::Ordered;
    use g2ard_core::simplify::{Pairwise, Paper, PaperPlan, flags};

    /// Counts after each round, `retention` of the one before kept.
    fn schedule(mut count: usize, retention: f64) -> Vec<usize> {
        let budget = count / RATIO;
        let mut counts = Vec::new();
        while count > budget {
            count = budget.max((retention * count as f64).ceil() as usize);
            counts.push(count);
        }
        counts
    }

    fn pairwise(bencher: Bencher, count: usize, policy: Pairwise) {
        let (scene, counts) = (Scene::of(count), schedule(count, 0.65));
        bencher.bench(|| {
            let (scene, control) = (scene.scene(), Control::default());
            let ordered = Ordered::new(&scene).expect("a valid scene");
            policy
                .run(&scene, &ordered, None, None, &counts, &control)
                .expect("a valid scene")
        });
    }

    #[divan::bench(args = COUNTS)]
    fn default_policy(bencher: Bencher, count: usize) {
        pairwise(bencher, count, Pairwise::default());
    }

    #[divan::bench(args = COUNTS)]
    fn fast_policy(bencher: Bencher, count: usize) {
        pairwise(bencher, count, Pairwise::fast());
    }

    #[divan::bench(args = COUNTS)]
    fn paper_flags(bencher: Bencher, count: usize) {
        let (splats, paper) = (Scene::of(count).splats(), Paper::default());
        let run = || flags(&splats, count / RATIO, &paper, &Cpu, &Control::default());
        bencher.bench(|| run().expect("never cancelled"));
    }

    /// The paper's flags included.
    #[divan::bench(args = COUNTS)]
    fn paper_policy(bencher: Bencher, count: usize) {
        let (scene, paper, counts) = (Scene::of(count), Paper::default(), schedule(count, 0.75));
        let plan = PaperPlan {
            schedule: &counts,
            cells: count / RATIO,
        };
        bencher.bench(|| {
            let (scene, control) = (scene.scene(), Control::default());
            let ordered = Ordered::new(&scene).expect("a valid scene");
            paper
                .run(&scene, &ordered, None, plan, &Cpu, &control)
                .expect("a valid scene")
        });
    }
}

mod raster {
    use super::*;

    fn view() -> Camera {
        cameras(1, WIDTH, HEIGHT)[0]
    }

    fn render(
        rasterizer: &mut Rasterizer,
        params: &Params,
        camera: &Camera,
        image: &mut [Vec<f32>; 2],
    ) {
        let [rgb, alpha] = image;
        let mut image = Image {
            rgb,
            alpha,
            depth: None,
            median: None,
        };
        rasterizer
            .forward(params, camera, &Settings::default(), [0.0; 3], &mut image)
            .expect("a valid view");
    }

    fn blank() -> [Vec<f32>; 2] {
        [3, 1].map(|channels| vec![0.0; channels * WIDTH * HEIGHT])
    }

    #[divan::bench(args = COUNTS)]
    fn forward(bencher: Bencher, count: usize) {
        let (scene, camera) = (Scene::of(count), view());
        let (mut rasterizer, mut image) = (Rasterizer::default(), blank());
        bencher.bench_local(|| render(&mut rasterizer, &scene.params(), &camera, &mut image));
    }

    #[divan::bench(args = COUNTS)]
    fn backward(bencher: Bencher, count: usize) {
        let scene = Scene::of(count);
        let (params, mut rasterizer) = (scene.params(), Rasterizer::default());
        render(&mut rasterizer, &params, &view(), &mut blank());
        let mut random = Lcg(1);
        let rgb: Vec<f32> = (0..3 * WIDTH * HEIGHT)
            .map(|_| random.uniform() as f32 - 0.5)
            .collect();
        let image = ImageGradients {
            rgb: &rgb,
            alpha: None,
            depth: None,
        };
        let mut slopes = Slopes::of(&params);
        bencher.bench_local(|| {
            rasterizer
                .backward(&params, &image, &mut slopes.gradients())
                .expect("a view was rendered");
        });
    }

    #[divan::bench(args = COUNTS)]
    fn visibility(bencher: Bencher, count: usize) {
        let (scene, camera, settings) = (Scene::of(count), view(), Settings::default());
        let (mut rasterizer, mut sums) = (Rasterizer::default(), Accumulated::new(count));
        bencher.bench_local(|| {
            rasterizer
                .accumulate(&scene.params(), &camera, &settings, &mut sums)
                .expect("a valid view");
        });
    }
}

mod ssim {
    use super::*;
    use g2ard_core::ssim::{Loss, Shape};

    #[divan::bench]
    fn loss_and_gradient(bencher: Bencher) {
        let shape = Shape {
            height: HEIGHT,
            width: WIDTH,
            channels: 3,
        };
        let mut random = Lcg(1);
        let [image, target] = [(); 2].map(|()| -> Vec<f32> {
            (0..shape.values())
                .map(|_| random.uniform() as f32)
                .collect()
        });
        let (mut loss, mut gradient) = (Loss::default(), vec![0.0; shape.values()]);
        bencher.bench_local(|| {
            loss.l1_ssim(&image, &target, shape, 0.2, &mut gradient)
                .expect("images of one shape")
        });
    }
}

mod select {
    use super::*;
    use g2ard_core::select::{Coverage, Occluders, Problem, Surface, visible_cells};

    const VIEWS: usize = 64;
    const CHOSEN: usize = 16;

    fn views() -> Vec<Camera> {
        cameras(VIEWS, WIDTH / 2, HEIGHT / 2)
    }

    /// A surface cell for every four Gaussians.
    fn surface(scene: &Scene) -> Surface {
        Surface::of(&scene.gaussians(), scene.means.len() / 4, &Cpu).expect("a valid scene")
    }

    fn seen_cells(scene: &Scene, surface: &Surface, views: &[Camera]) -> Vec<Vec<u32>> {
        let occluders = Occluders::of(&scene.gaussians());
        visible_cells(&occluders, surface, 0.01, views, &Control::default())
            .expect("never cancelled")
    }

    #[divan::bench(args = COUNTS)]
    fn surface_cells(bencher: Bencher, count: usize) {
        let scene = Scene::of(count);
        bencher.bench(|| surface(&scene));
    }

    /// The cells that 64 views of 320×240 see.
    #[divan::bench(args = COUNTS)]
    fn cells_seen(bencher: Bencher, count: usize) {
        let (scene, views) = (Scene::of(count), views());
        let surface = surface(&scene);
        bencher.bench(|| seen_cells(&scene, &surface, &views));
    }

    /// 16 of the 64 views by directional coverage, lazily.
    #[divan::bench(args = COUNTS)]
    fn greedy_choice(bencher: Bencher, count: usize) {
        let (scene, views) = (Scene::of(count), views());
        let surface = surface(&scene);
        let positions: Vec<_> = views.iter().map(Camera::position).collect();
        let problem = Problem {
            surface: &surface,
            visible: &seen_cells(&scene, &surface, &views),
            positions: &positions,
            directional: true,
        };
        let coverage = Coverage::default();
        let run = || problem.greedy(CHOSEN, &coverage, &Control::default());
        bencher.bench(|| run().expect("a valid problem"));
    }
}
