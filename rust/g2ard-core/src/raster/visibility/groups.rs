//! The scene in groups of sixteen rows, and the groups that a view can see.

use crate::raster::bounds::Bounds;
use crate::raster::params::Source;
use crate::raster::simd::{LANES, Lanes, Lanes16};
use crate::scene::{SceneRef, limits};

/// The values of sixteen rows.
pub struct Group {
    /// Mean, quaternion, scales (linear, so that a unit twice as long rounds equally), logit; lanes past the end repeat
    /// the last row.
    values: [Lanes16; 11],
}

impl Group {
    pub fn of(scene: &SceneRef, rows: &[u32], shift: [f64; 3]) -> (Self, Bounds) {
        let mut values = [Lanes16::default(); 11];
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        let mut scale = 0f32;
        for l in 0..LANES {
            let row = rows[l.min(rows.len() - 1)] as usize;
            let mean = scene.means.get(row);
            for k in 0..3 {
                let m = (mean[k] - shift[k]) as f32;
                values[k].0[l] = m;
                (low[k], high[k]) = (low[k].min(m), high[k].max(m));
                let s = scene.scales[row][k].clamp(limits::DRAWN_SCALES.0, limits::DRAWN_SCALES.1);
                values[7 + k].0[l] = s;
                scale = scale.max(s);
            }
            for k in 0..4 {
                values[3 + k].0[l] = scene.quats[row][k];
            }
            values[10].0[l] =
                scene.logit_opacities[row].clamp(limits::DRAWN_LOGITS.0, limits::DRAWN_LOGITS.1);
        }
        (Self { values }, Bounds::of_box(low, high, scale))
    }

    /// All values of a row.
    pub fn row(&self, lane: usize) -> [f32; 11] {
        self.values.map(|value| value.0[lane])
    }

    /// The mean of a row.
    pub fn mean(&self, lane: usize) -> [f64; 3] {
        [0, 1, 2].map(|k| f64::from(self.values[k].0[lane]))
    }
}

/// A group that a view can see.
#[derive(Debug, Clone, Copy)]
pub struct VisibleGroup {
    pub number: u32,
    /// The first and the last row of the image's tiles that its rows can touch.
    pub tile_rows: [u16; 2],
}

/// The groups a view can see, one after another.
#[derive(Clone, Copy)]
pub struct VisibleGroups<'a> {
    pub groups: &'a [Group],
    /// Numbers of the groups that the view can see, ascending.
    pub visible: &'a [u32],
    pub rows: usize,
}

impl VisibleGroups<'_> {
    #[inline(always)]
    fn value<F: Lanes>(&self, group: usize, value: usize) -> F {
        F::load(&self.groups[self.visible[group] as usize].values[value])
    }
}

impl Source for VisibleGroups<'_> {
    const COLOURED: bool = false;

    #[inline(always)]
    fn len(&self) -> usize {
        self.rows
    }
    #[inline(always)]
    fn sh_coeffs(&self) -> usize {
        1
    }
    #[inline(always)]
    fn mean<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.value(group, axis)
    }
    #[inline(always)]
    fn quat<F: Lanes>(&self, group: usize, part: usize) -> F {
        self.value(group, 3 + part)
    }
    #[inline(always)]
    fn scale<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.value(group, 7 + axis)
    }
    #[inline(always)]
    fn logit_opacity<F: Lanes>(&self, group: usize) -> F {
        self.value(group, 10)
    }
    #[inline(always)]
    fn sh<F: Lanes>(&self, _group: usize, _k: usize, _c: usize) -> F {
        F::zero()
    }
}
