//! Bounds of neighbouring rows: a view projects only rows whose bounds it can see.

use super::frustum::Frustum;

/// Groups of sixteen rows that share bounds; one under Miri, which runs few rows.
pub const GROUPS: usize = if cfg!(miri) { 1 } else { 16 };

/// Bounds of some rows, stored apart from their values because a view reads the bounds of all groups.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Centre of the means' box.
    centre: [f32; 3],
    /// Half the sides of that box.
    half: [f32; 3],
    /// The largest scale.
    scale: f32,
}

impl Bounds {
    pub(crate) fn of_box(low: [f32; 3], high: [f32; 3], scale: f32) -> Self {
        let centre = [0, 1, 2].map(|k| 0.5 * low[k] + 0.5 * high[k]);
        Self {
            centre,
            half: [0, 1, 2].map(|k| (high[k] - centre[k]).max(centre[k] - low[k])),
            scale,
        }
    }

    /// Bounds of all parts, wide enough that a view which rejects them rejects each part.
    pub(crate) fn around(parts: &[Self]) -> Self {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for part in parts {
            for k in 0..3 {
                low[k] = low[k].min(part.centre[k] - part.half[k]);
                high[k] = high[k].max(part.centre[k] + part.half[k]);
            }
        }
        let scale = parts.iter().fold(0f32, |s, part| s.max(part.scale));
        let mut all = Self::of_box(low, high, scale);
        all.half = all.half.map(|h| h * WIDER);
        all
    }

    /// The first and the last row of the image's tiles that any of the rows can touch.
    pub(crate) fn tile_rows(&self, frustum: &Frustum) -> Option<[u16; 2]> {
        frustum.tile_rows(self.centre, self.half, self.scale)
    }

    /// The least depth of a mean.
    pub(crate) fn depth(&self, frustum: &Frustum) -> f64 {
        frustum.depth(self.centre, self.half)
    }
}

/// Covers the slack of [`Frustum`], which is a share of its box's own distance, and rounding.
const WIDER: f32 = 1.0001;
