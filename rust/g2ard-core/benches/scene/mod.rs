//! Seeded scenes and views, made on the spot: a bumpy ball of small discs, textured, in no order.

use g2ard_core::Splats;
use g2ard_core::random::Lcg;
use g2ard_core::raster::{Camera, Gradients, Params};
use g2ard_core::scene::{Means, SceneRef};
use g2ard_core::select::Gaussians;

use glam::{DQuat, DVec3};

/// SH of degree 3, as trained scenes have.
const SH_COEFFS: usize = 16;

/// The same Gaussians in every layout that a kernel asks for.
pub struct Scene {
    pub means: Vec<[f64; 3]>,
    means32: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    log_scales: Vec<[f32; 3]>,
    logits: Vec<f32>,
    opacities: Vec<f32>,
    sh0: Vec<[f32; 3]>,
    sh_rest: Vec<[f32; 3]>,
}

impl Scene {
    /// `count` discs that cover the ball about as densely whatever their number.
    pub fn of(count: usize) -> Self {
        let mut random = Lcg(count as u64);
        let spacing = (4.0 * std::f64::consts::PI / count as f64).sqrt();
        let mut scene = Self {
            means: Vec::with_capacity(count),
            means32: Vec::new(),
            quats: Vec::with_capacity(count),
            scales: Vec::with_capacity(count),
            log_scales: Vec::new(),
            logits: Vec::with_capacity(count),
            opacities: Vec::new(),
            sh0: Vec::with_capacity(count),
            sh_rest: Vec::with_capacity(count * (SH_COEFFS - 1)),
        };
        for _ in 0..count {
            scene.push(spacing, &mut random);
        }
        let means32 = scene.means.iter().map(|m| m.map(|v| v as f32));
        scene.means32 = means32.collect();
        let log_scales = scene.scales.iter().map(|s| s.map(f32::ln));
        scene.log_scales = log_scales.collect();
        let opacities = scene.logits.iter().map(|l| 1.0 / (1.0 + (-l).exp()));
        scene.opacities = opacities.collect();
        scene
    }

    fn push(&mut self, spacing: f64, random: &mut Lcg) {
        let z = random.between(-1.0, 1.0);
        let (turn, across) = (
            random.between(0.0, std::f64::consts::TAU),
            (1.0 - z * z).sqrt(),
        );
        let normal = DVec3::new(across * turn.cos(), across * turn.sin(), z);
        let bump = 0.1 * (7.0 * normal.x).sin() * (5.0 * normal.y).cos();
        let mean = (1.0 + bump + random.between(-0.005, 0.005)) * normal;
        let quat = DQuat::from_rotation_arc(DVec3::Z, normal);
        let mut wide = || (spacing * random.between(-0.7, 0.3).exp()) as f32;
        self.scales.push([wide(), wide(), 0.1 * spacing as f32]);
        self.means.push(mean.to_array());
        self.quats
            .push([quat.w, quat.x, quat.y, quat.z].map(|v| v as f32));
        self.logits.push(random.between(-4.0, 5.0) as f32);
        let pattern = (20.0 * mean.x).sin() * (20.0 * mean.z).sin();
        let color = [pattern, mean.y, 0.5 * mean.z];
        self.sh0
            .push(color.map(|c| (c + random.between(-0.3, 0.3)) as f32));
        let rest = (1..SH_COEFFS).map(|_| [(); 3].map(|()| random.between(-0.05, 0.05) as f32));
        self.sh_rest.extend(rest);
    }

    pub fn scene(&self) -> SceneRef<'_> {
        SceneRef {
            means: Means::F64(&self.means),
            quats: &self.quats,
            scales: &self.scales,
            logit_opacities: &self.logits,
            sh0: &self.sh0,
            sh_rest: &self.sh_rest,
            rest: SH_COEFFS - 1,
        }
    }

    pub fn params(&self) -> Params<'_> {
        Params {
            means: self.means32.as_flattened(),
            quats: self.quats.as_flattened(),
            log_scales: self.log_scales.as_flattened(),
            logit_opacities: &self.logits,
            sh0: self.sh0.as_flattened(),
            sh_n: self.sh_rest.as_flattened(),
            sh_coeffs: SH_COEFFS,
        }
    }

    pub fn gaussians(&self) -> Gaussians<'_> {
        Gaussians {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
        }
    }

    pub fn splats(&self) -> Splats {
        let rows = self.sh0.iter().zip(self.sh_rest.chunks(SH_COEFFS - 1));
        Splats {
            means: self.means.clone(),
            quats: self.quats.clone(),
            scales: self.scales.clone(),
            logit_opacities: self.logits.clone(),
            sh: rows
                .flat_map(|(dc, rest)| std::iter::once(dc).chain(rest))
                .copied()
                .collect(),
            sh_coeffs: SH_COEFFS,
        }
    }
}

/// Room for the gradients of a scene.
pub struct Slopes([Vec<f32>; 6]);

impl Slopes {
    pub fn of(p: &Params) -> Self {
        let like = [
            p.means,
            p.quats,
            p.log_scales,
            p.logit_opacities,
            p.sh0,
            p.sh_n,
        ];
        Self(like.map(|slice| vec![0.0; slice.len()]))
    }

    pub fn gradients(&mut self) -> Gradients<'_> {
        let [means, quats, log_scales, logit_opacities, sh0, sh_n] = &mut self.0;
        Gradients {
            means,
            quats,
            log_scales,
            logit_opacities,
            sh0,
            sh_n,
        }
    }
}

/// `count` cameras spread over a sphere, looking at the ball, which fills most of the image's height.
pub fn cameras(count: usize, width: usize, height: usize) -> Vec<Camera> {
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let place = |i: usize| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
        let turn = std::f64::consts::TAU * (i as f64 * golden).fract();
        let across = (1.0 - z * z).sqrt();
        2.5 * DVec3::new(across * turn.cos(), across * turn.sin(), z)
    };
    let look = |eye: DVec3| {
        let forward = -eye.normalize();
        let right = forward.any_orthonormal_vector();
        let axes = [right, forward.cross(right), forward];
        let focal = 0.9 * height as f64;
        Camera {
            viewmat: axes.map(|a| [a.x, a.y, a.z, -a.dot(eye)]),
            fx: focal,
            fy: focal,
            cx: 0.5 * width as f64,
            cy: 0.5 * height as f64,
            width,
            height,
            near: 0.01,
        }
    };
    (0..count).map(place).map(look).collect()
}
