//! The scene type: a structure of arrays.

/// N Gaussians. Means are f64 and centred near the origin by the caller (maps have UTM offsets);
/// everything else is f32, in the space its name says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splats {
    pub means: Vec<[f64; 3]>,
    /// wxyz; not necessarily normalised. (glam's `Quat` is xyzw.)
    pub quats: Vec<[f32; 4]>,
    /// Linear standard deviations along the rotated axes.
    pub scales: Vec<[f32; 3]>,
    pub logit_opacities: Vec<f32>,
    /// N × `sh_coeffs` RGB triples, coefficient-major within a Gaussian: `[dc, band 1 …]`.
    pub sh: Vec<[f32; 3]>,
    /// (degree + 1)²: 1, 4, 9 or 16.
    pub sh_coeffs: usize,
}

impl Splats {
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// The SH triples of Gaussian `i`, `sh_coeffs` of them.
    pub fn sh_of(&self, i: usize) -> &[[f32; 3]] {
        &self.sh[i * self.sh_coeffs..(i + 1) * self.sh_coeffs]
    }
}
