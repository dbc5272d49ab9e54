//! Likeness of a render and a photo, independent of the light.

use rayon::prelude::*;

use super::normal::median;
use super::{Size, dot};
use crate::Result;

/// Variance of grey in a window, in [0, 1]², below which it has no contrast to compare (1 %).
const FLAT: f64 = 1e-4;
/// Sums over windows: a, b, a², b², ab and the number of unmasked pixels.
const MOMENTS: usize = 6;

/// Median ZNCC of two grey images over the `side`×`side` windows without masked pixels in which `b` has contrast; 0 if
/// there is no such window. A window in which `a` is flat has ZNCC 0.
pub fn local_zncc(a: &[f64], b: &[f64], mask: &[bool], size: Size, side: usize) -> Result<f64> {
    size.check("a", a, 1)?;
    size.check("b", b, 1)?;
    size.check("mask", mask, 1)?;
    refuse!(side == 0 || side > size.height.min(size.width) =>
        "side", format!("1 to {}", size.height.min(size.width)), side);
    // squares about the images' middles: less is lost to rounding than about 0
    let about = [mean(a), mean(b)];
    let row = |sums: &mut [Vec<f64>; MOMENTS], y: usize| -> Vec<f64> {
        down_columns(sums, [a, b], mask, about, size.width, y..y + side);
        let pixels = (side * side) as f64;
        let mut out = Vec::new();
        for x in 0..=size.width - side {
            let sum = |k: usize| sums[k][x..x + side].iter().sum::<f64>() / pixels;
            if sum(5) < 1.0 {
                continue;
            }
            let (of_a, of_b) = (sum(0), sum(1));
            let of_bb = sum(3) - of_b * of_b;
            if of_bb <= FLAT {
                continue;
            }
            let scale = ((sum(2) - of_a * of_a).max(0.0) * of_bb).sqrt();
            let both = sum(4) - of_a * of_b;
            let zncc = if scale > 1e-9 { both / scale } else { 0.0 };
            out.push(zncc.clamp(-1.0, 1.0));
        }
        out
    };
    let rows: Vec<Vec<f64>> = (0..=size.height - side)
        .into_par_iter()
        .map_init(|| std::array::from_fn(|_| vec![0.0; size.width]), row)
        .collect();
    Ok(median(&mut rows.concat()))
}

fn mean(values: &[f64]) -> f64 {
    dot(values, &vec![1.0; values.len()]) / values.len() as f64
}

/// Each column's sums over some rows.
fn down_columns(
    sums: &mut [Vec<f64>; MOMENTS],
    images: [&[f64]; 2],
    mask: &[bool],
    about: [f64; 2],
    width: usize,
    rows: std::ops::Range<usize>,
) {
    for sum in sums.iter_mut() {
        sum.fill(0.0);
    }
    let [of_a, of_b, of_aa, of_bb, of_ab, counted] = sums;
    for y in rows {
        let row = y * width..(y + 1) * width;
        let (a, b, mask) = (&images[0][row.clone()], &images[1][row.clone()], &mask[row]);
        for x in 0..width {
            let (a, b) = (a[x] - about[0], b[x] - about[1]);
            of_a[x] += a;
            of_b[x] += b;
            of_aa[x] += a * a;
            of_bb[x] += b * b;
            of_ab[x] += a * b;
            counted[x] += f64::from(u8::from(mask[x]));
        }
    }
}
