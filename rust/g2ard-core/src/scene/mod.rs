//! A caller's scene, borrowed, with checked values and an order that only its content decides.

mod gaussian;
pub mod limits;
mod ordered;

pub use gaussian::Gaussian;
pub use ordered::Ordered;
pub(crate) use ordered::power_of_two_below;

use std::cmp::Ordering;

use crate::{Error, Result};

/// Means as the caller holds them.
#[derive(Debug, Clone, Copy)]
pub enum Means<'a> {
    F32(&'a [[f32; 3]]),
    F64(&'a [[f64; 3]]),
}

impl Means<'_> {
    pub fn len(&self) -> usize {
        match self {
            Self::F32(m) => m.len(),
            Self::F64(m) => m.len(),
        }
    }

    pub fn get(&self, i: usize) -> [f64; 3] {
        match self {
            Self::F32(m) => m[i].map(f64::from),
            Self::F64(m) => m[i],
        }
    }
}

/// N Gaussians, borrowed. Logits may be infinite (α = 0 or 1); everything else is finite.
#[derive(Debug, Clone, Copy)]
pub struct SceneRef<'a> {
    pub means: Means<'a>,
    pub quats: &'a [[f32; 4]],
    pub scales: &'a [[f32; 3]],
    pub logit_opacities: &'a [f32],
    pub sh0: &'a [[f32; 3]],
    /// N × `rest` triples.
    pub sh_rest: &'a [[f32; 3]],
    pub rest: usize,
}

impl SceneRef<'_> {
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// The logit of a row, finite.
    pub fn logit(&self, row: usize) -> f32 {
        limits::finite_logit(self.logit_opacities[row])
    }

    /// Band 0 and the higher bands of a row.
    pub fn sh_of(&self, row: usize) -> ([f32; 3], &[[f32; 3]]) {
        (
            self.sh0[row],
            &self.sh_rest[row * self.rest..(row + 1) * self.rest],
        )
    }

    fn validate(&self) -> Result<()> {
        let n = self.len();
        refuse!(n >= u32::MAX as usize => "means", "fewer than 2³² − 1 rows", n);
        for (name, rows) in [
            ("quats", self.quats.len()),
            ("scales", self.scales.len()),
            ("logit_opacities", self.logit_opacities.len()),
            ("sh0", self.sh0.len()),
        ] {
            Error::unless_equal(name, rows, n, "rows")?;
        }
        Error::unless_equal("shN", self.sh_rest.len(), n * self.rest, "triples")
    }

    /// All attributes of two rows, bit by bit: equal only where the rows are interchangeable.
    fn compare(&self, a: usize, b: usize) -> Ordering {
        let bits = |v: f32| v.to_bits();
        let triple = |v: &[f32; 3]| v.map(bits);
        let rest = |i: usize| {
            self.sh_rest[i * self.rest..(i + 1) * self.rest]
                .iter()
                .map(triple)
        };
        self.means
            .get(a)
            .map(f64::to_bits)
            .cmp(&self.means.get(b).map(f64::to_bits))
            .then_with(|| self.scales[a].map(bits).cmp(&self.scales[b].map(bits)))
            .then_with(|| self.quats[a].map(bits).cmp(&self.quats[b].map(bits)))
            .then_with(|| bits(self.logit_opacities[a]).cmp(&bits(self.logit_opacities[b])))
            .then_with(|| triple(&self.sh0[a]).cmp(&triple(&self.sh0[b])))
            .then_with(|| rest(a).cmp(rest(b)))
    }
}
