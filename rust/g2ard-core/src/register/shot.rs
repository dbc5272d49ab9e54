//! A render made ready for alignment.

use rayon::prelude::*;

use super::Size;
use crate::Result;

const LUMA: [f64; 3] = [0.299, 0.587, 0.114];

/// Each value is of a pixel, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// Luma of the render clipped to [0, 1], blurred by (1, 4, 6, 4, 1)/16 along both axes.
    pub grey: Vec<f64>,
    /// Expected depth; 1 in masked pixels.
    pub depth: Vec<f64>,
    /// Opaque enough, and not beside an edge of depth.
    pub mask: Vec<bool>,
}

/// A render as alignment needs it. `rgb` is (H, W, 3), `alpha` and `depth` (H, W), depth times alpha. A pixel is
/// unmasked if alpha is at least `min_alpha` and depth differs by at most `max_edge` of the lesser from each of its
/// four neighbours.
pub fn shot(
    rgb: &[f32],
    alpha: &[f32],
    depth: &[f32],
    size: Size,
    min_alpha: f64,
    max_edge: f64,
) -> Result<Shot> {
    size.check("image", rgb, 3)?;
    size.check("alpha", alpha, 1)?;
    size.check("depth", depth, 1)?;
    let opaque = |i: usize| f64::from(alpha[i]) >= min_alpha;
    let at = |i: usize| {
        if opaque(i) {
            f64::from(depth[i]) / f64::from(alpha[i]).max(1e-6)
        } else {
            1.0
        }
    };
    let Size { height, width } = size;
    let depths: Vec<f64> = (0..size.pixels()).into_par_iter().map(at).collect();
    let smooth = |a: f64, b: f64| (a - b).abs() <= max_edge * a.min(b);
    let mask: Vec<bool> = (0..size.pixels())
        .into_par_iter()
        .map(|i| {
            let (row, column, own) = (i / width, i % width, depths[i]);
            opaque(i)
                && own > 0.0
                && (column == 0 || smooth(own, depths[i - 1]))
                && (column + 1 == width || smooth(own, depths[i + 1]))
                && (row == 0 || smooth(own, depths[i - width]))
                && (row + 1 == height || smooth(own, depths[i + width]))
        })
        .collect();
    let depth = depths.iter().zip(&mask);
    let depth = depth.map(|(&d, &m)| if m { d } else { 1.0 }).collect();
    let grey: Vec<f64> = rgb.par_chunks(3).map(luma).collect();
    Ok(Shot {
        grey: blurred(&grey, size),
        depth,
        mask,
    })
}

fn luma(rgb: &[f32]) -> f64 {
    let clipped = |c: usize| f64::from(rgb[c].clamp(0.0, 1.0));
    clipped(0) * LUMA[0] + clipped(1) * LUMA[1] + clipped(2) * LUMA[2]
}

/// Blur along the columns, then along the rows, repeating the border.
fn blurred(grey: &[f64], size: Size) -> Vec<f64> {
    let Size { height, width } = size;
    let mut out = vec![0.0; grey.len()];
    let rows = out.par_chunks_mut(width).enumerate();
    rows.for_each_init(
        || vec![0.0; width],
        |column, (y, out)| {
            let row = |k: usize| {
                let from = (y + k).saturating_sub(2).min(height - 1) * width;
                &grey[from..from + width]
            };
            let [a, b, c, d, e] = [row(0), row(1), row(2), row(3), row(4)];
            for x in 0..width {
                column[x] = ((a[x] + e[x]) + 4.0 * (b[x] + d[x]) + 6.0 * c[x]) / 16.0;
            }
            for (x, out) in out.iter_mut().enumerate() {
                let near = |k: usize| column[(x + k).saturating_sub(2).min(width - 1)];
                let (a, b, c, d, e) = (near(0), near(1), near(2), near(3), near(4));
                *out = ((a + e) + 4.0 * (b + d) + 6.0 * c) / 16.0;
            }
        },
    );
    out
}
