//! The scene type: a structure of arrays.

use crate::{Error, Result};

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

    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// The SH triples of Gaussian `i`, `sh_coeffs` of them.
    pub fn sh_of(&self, i: usize) -> &[[f32; 3]] {
        &self.sh[i * self.sh_coeffs..(i + 1) * self.sh_coeffs]
    }

    /// Every array has N rows, the SH degree is 0–3 and every value is finite.
    pub fn validate(&self) -> Result<()> {
        let n = self.len();
        if ![1, 4, 9, 16].contains(&self.sh_coeffs) {
            return Err(Error::invalid(
                "sh",
                "1, 4, 9 or 16 coefficients",
                self.sh_coeffs,
            ));
        }
        for (name, rows) in [
            ("quats", self.quats.len()),
            ("scales", self.scales.len()),
            ("logit_opacities", self.logit_opacities.len()),
            ("sh", self.sh.len() / self.sh_coeffs),
        ] {
            Error::unless_equal(name, rows, n, "rows")?;
        }
        finite("means", &self.means, |m| m.iter().all(|v| v.is_finite()))?;
        finite("quats", &self.quats, |q| q.iter().all(|v| v.is_finite()))?;
        finite("scales", &self.scales, |s| s.iter().all(|v| v.is_finite()))?;
        finite("logit_opacities", &self.logit_opacities, |v| v.is_finite())?;
        let coeffs = self.sh_coeffs;
        finite("sh", &self.sh, |c| c.iter().all(|v| v.is_finite())).map_err(|e| match e {
            Error::NonFinite {
                field,
                count,
                first_index,
            } => Error::NonFinite {
                field,
                count,
                first_index: first_index / coeffs,
            },
            other => other,
        })
    }
}

fn finite<T>(field: &'static str, rows: &[T], ok: impl Fn(&T) -> bool) -> Result<()> {
    let Some(first_index) = rows.iter().position(|r| !ok(r)) else {
        return Ok(());
    };
    let count = rows.iter().filter(|r| !ok(r)).count();
    Err(Error::NonFinite {
        field,
        count,
        first_index,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> Splats {
        Splats {
            means: vec![[0.0; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            scales: vec![[1.0; 3]; 2],
            logit_opacities: vec![0.0; 2],
            sh: vec![[0.0; 3]; 8],
            sh_coeffs: 4,
        }
    }

    #[test]
    fn valid_scene_passes() {
        assert_eq!(two().validate(), Ok(()));
    }

    #[test]
    fn names_the_field_and_the_row() {
        let mut s = two();
        s.sh[5][1] = f32::NAN;
        assert_eq!(
            s.validate(),
            Err(Error::NonFinite {
                field: "sh",
                count: 1,
                first_index: 1
            })
        );
        s.quats.pop();
        assert_eq!(s.validate(), Err(Error::invalid("quats", "2 rows", 1)));
    }
}
