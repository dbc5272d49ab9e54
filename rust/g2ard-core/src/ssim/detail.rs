//! Detail of images for reports: differences between neighbouring pixels, and local contrast.

use std::iter::repeat_n;
use std::ops::Range;

use rayon::prelude::*;

use super::Shape;
use crate::raster::simd::{Isa, Kernel, LANES, Lanes, dispatch};
use crate::{Error, Result};

/// Sums over the differences g between neighbouring pixels of an image, and g′ of its target.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Steps {
    pub count: f64,
    /// Σ (g − g′)².
    pub error: f64,
    /// Σ g².
    pub own: f64,
    /// Σ g′².
    pub wanted: f64,
    /// Σ g·g′.
    pub common: f64,
}

impl Steps {
    fn plus(self, other: Self) -> Self {
        Self {
            count: self.count + other.count,
            error: self.error + other.error,
            own: self.own + other.own,
            wanted: self.wanted + other.wanted,
            common: self.common + other.common,
        }
    }
}

/// Two images and the pixels that count; all do without a mask.
#[derive(Clone, Copy)]
pub struct Compared<'a> {
    image: &'a [f32],
    target: &'a [f32],
    shape: Shape,
    mask: Option<&'a [bool]>,
}

impl<'a> Compared<'a> {
    /// `mask`: height × width.
    pub fn new(
        image: &'a [f32],
        target: &'a [f32],
        shape: Shape,
        mask: Option<&'a [bool]>,
    ) -> Result<Self> {
        shape.check("image", image)?;
        shape.check("target", target)?;
        let pixels = shape.height * shape.width;
        Error::unless_equal("mask", mask.map_or(pixels, <[bool]>::len), pixels, "values")?;
        Ok(Self {
            image,
            target,
            shape,
            mask,
        })
    }

    /// Differences along columns and along rows. With a mask, one counts if both its pixels do.
    pub fn steps(&self) -> Steps {
        let Shape { height, width, .. } = self.shape;
        let of_row = |y: usize| {
            let right = self.steps_between(y * width, 1, width - 1);
            let down = match y + 1 < height {
                true => self.steps_between(y * width, width, width),
                false => Steps::default(),
            };
            right.plus(down)
        };
        let rows: Vec<Steps> = (0..height).into_par_iter().map(of_row).collect();
        rows.into_iter().fold(Steps::default(), Steps::plus)
    }

    /// Differences between the `count` pixels from `first` on and those `away` pixels behind them.
    fn steps_between(&self, first: usize, away: usize, count: usize) -> Steps {
        let channels = self.shape.channels;
        let (near, far) = (first..first + count, first + away..first + away + count);
        let values = |image: &'a [f32], pixels: &Range<usize>| {
            &image[pixels.start * channels..pixels.end * channels]
        };
        let all = RowSteps {
            own: [values(self.image, &near), values(self.image, &far)],
            wanted: [values(self.target, &near), values(self.target, &far)],
        };
        let Some(mask) = self.mask else {
            return dispatch(Isa::detect(), all);
        };
        let both = mask[near].iter().zip(&mask[far]).map(|(a, b)| *a && *b);
        let counted: Vec<bool> = both.flat_map(|counts| repeat_n(counts, channels)).collect();
        let kept = |row: &[f32]| -> Vec<f32> {
            let pairs = row.iter().zip(&counted).filter(|(_, counts)| **counts);
            pairs.map(|(value, _)| *value).collect()
        };
        let (own, wanted) = (all.own.map(kept), all.wanted.map(kept));
        let some = RowSteps {
            own: [&own[0], &own[1]],
            wanted: [&wanted[0], &wanted[1]],
        };
        dispatch(Isa::detect(), some)
    }

    /// Local contrast of each region, row by row: [mean of the target's squared, mean of its product with the
    /// image's].
    ///
    /// Contrast is luminance minus its mean around the pixel, over the target's mean there and [`GLARE`].
    pub fn contrasts(&self) -> Vec<[f64; 2]> {
        let Shape { height, width, .. } = self.shape;
        let curve = gamma();
        let [own, wanted] = [self.image, self.target].map(|image| self.luminance(image, &curve));
        let bands: Vec<Vec<[f64; 2]>> = (0..height.div_ceil(REGION))
            .into_par_iter()
            .map(|band| {
                let mut sums = vec![[0.0; 2]; width.div_ceil(REGION)];
                let rows = band * REGION..height.min((band + 1) * REGION);
                for y in rows.clone() {
                    let around = [&own, &wanted].map(|plane| box_means(plane, y, self.shape));
                    let at = y * width;
                    for x in 0..width {
                        if self.mask.is_some_and(|mask| !mask[at + x]) {
                            continue;
                        }
                        let [own, wanted] =
                            [own[at + x] - around[0][x], wanted[at + x] - around[1][x]];
                        let light = around[1][x] + GLARE;
                        let [own, wanted] = [own / light, wanted / light].map(f64::from);
                        sums[x / REGION][0] += wanted * wanted;
                        sums[x / REGION][1] += own * wanted;
                    }
                }
                for (region, sums) in sums.iter_mut().enumerate() {
                    let columns = width.min((region + 1) * REGION) - region * REGION;
                    let area = (rows.len() * columns) as f64;
                    *sums = sums.map(|sum| sum / area);
                }
                sums
            })
            .collect();
        bands.into_iter().flatten().collect()
    }

    /// The light of a screen that shows an image: display gamma 2.2, weights of Rec. 709.
    fn luminance(&self, image: &[f32], curve: &[f32]) -> Vec<f32> {
        let channels = self.shape.channels;
        let weights = match channels {
            3 => vec![0.2126, 0.7152, 0.0722],
            _ => vec![1.0 / channels as f32; channels],
        };
        let of = |pixel: &[f32]| {
            pixel
                .iter()
                .zip(&weights)
                .map(|(v, w)| w * light_of(*v, curve))
                .sum()
        };
        image
            .par_chunks(channels)
            .with_min_len(1 << 12)
            .map(of)
            .collect()
    }
}

/// Intervals of the table of x^2.2; between its entries a line is within 2e-8 of the curve.
const ENTRIES: usize = 1 << 12;

fn gamma() -> Vec<f32> {
    let of = |i: usize| (i as f64 / ENTRIES as f64).powf(2.2) as f32;
    (0..=ENTRIES + 1).map(of).collect()
}

/// x^2.2 of a value, clipped to [0, 1]; NaN stays.
#[inline(always)]
fn light_of(value: f32, curve: &[f32]) -> f32 {
    let at = value.clamp(0.0, 1.0) * ENTRIES as f32;
    let below = at as usize; // 0 for NaN
    let [low, high] = [curve[below], curve[below + 1]];
    low + (at - below as f32) * (high - low)
}

/// Means of the squares around each pixel of row `y`; the image's edge is repeated.
fn box_means(plane: &[f32], y: usize, shape: Shape) -> Vec<f32> {
    let Shape { height, width, .. } = shape;
    let reach = FINE / 2;
    let mut columns = vec![0f32; width + 2 * reach];
    for down in 0..FINE {
        let row = (y + down).saturating_sub(reach).min(height - 1);
        let row = &plane[row * width..][..width];
        for (sum, value) in columns[reach..].iter_mut().zip(row) {
            *sum += value;
        }
    }
    let (first, last) = (columns[reach], columns[reach + width - 1]);
    columns[..reach].fill(first);
    columns[reach + width..].fill(last);
    let mut means = vec![0f32; width];
    for right in 0..FINE {
        for (mean, sum) in means.iter_mut().zip(&columns[right..]) {
            *mean += sum;
        }
    }
    let area = (FINE * FINE) as f32;
    means.iter_mut().for_each(|mean| *mean /= area);
    means
}

/// Side in pixels of the squares whose means are subtracted.
const FINE: usize = 9;
/// Side in pixels of regions.
const REGION: usize = 32;
/// Light that a screen reflects in a room, as a share of its white.
const GLARE: f32 = 0.01;

/// Values of two rows of pixels: near ones, and those at the far end of each difference.
struct RowSteps<'a> {
    own: [&'a [f32]; 2],
    wanted: [&'a [f32]; 2],
}

impl Kernel for RowSteps<'_> {
    type Output = Steps;

    #[inline(always)]
    fn run<F: Lanes>(self) -> Steps {
        let [near, far] = self.own;
        let [wanted_near, wanted_far] = self.wanted;
        let mut lanes = [[0f64; LANES]; 4];
        for first in (0..near.len()).step_by(LANES) {
            let chunk = first..near.len().min(first + LANES);
            let (near, far) = (&near[chunk.clone()], &far[chunk.clone()]);
            let (wanted_near, wanted_far) = (&wanted_near[chunk.clone()], &wanted_far[chunk]);
            for lane in 0..near.len() {
                let own = f64::from(far[lane] - near[lane]);
                let wanted = f64::from(wanted_far[lane] - wanted_near[lane]);
                lanes[0][lane] += (own - wanted) * (own - wanted);
                lanes[1][lane] += own * own;
                lanes[2][lane] += wanted * wanted;
                lanes[3][lane] += own * wanted;
            }
        }
        let mut sums = [0.0; 4];
        for k in 0..4 {
            for lane in 0..LANES {
                sums[k] += lanes[k][lane];
            }
        }
        Steps {
            count: near.len() as f64,
            error: sums[0],
            own: sums[1],
            wanted: sums[2],
            common: sums[3],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    const SHAPE: Shape = Shape {
        height: 70,
        width: 41,
        channels: 3,
    };

    fn images() -> [Vec<f32>; 2] {
        let mut random = Lcg(9);
        [0, 1].map(|_| {
            (0..SHAPE.values())
                .map(|_| 1.2 * random.uniform_f32() - 0.1)
                .collect()
        })
    }

    /// Contrast by the definition, one pixel at a time.
    fn naive(a: &[f32], b: &[f32], mask: Option<&[bool]>) -> Vec<[f64; 2]> {
        let Shape { height, width, .. } = SHAPE;
        let light = |image: &[f32], y: usize, x: usize| {
            let value = |c: usize| {
                f64::from(image[(y * width + x) * 3 + c])
                    .clamp(0.0, 1.0)
                    .powf(2.2)
            };
            0.2126 * value(0) + 0.7152 * value(1) + 0.0722 * value(2)
        };
        let mean = |image: &[f32], y: usize, x: usize| {
            let place = |at: usize, k: usize, most: usize| (at + k).saturating_sub(4).min(most - 1);
            let cell = |k: usize| light(image, place(y, k / 9, height), place(x, k % 9, width));
            (0..81).map(cell).sum::<f64>() / 81.0
        };
        let (across, down) = (width.div_ceil(32), height.div_ceil(32));
        let (mut sums, mut areas) = (vec![[0.0; 2]; across * down], vec![0.0; across * down]);
        for y in 0..height {
            for x in 0..width {
                let region = y / 32 * across + x / 32;
                areas[region] += 1.0;
                if mask.is_none_or(|mask| mask[y * width + x]) {
                    let glare = mean(b, y, x) + 0.01;
                    let own = (light(a, y, x) - mean(a, y, x)) / glare;
                    let wanted = (light(b, y, x) - mean(b, y, x)) / glare;
                    sums[region][0] += wanted * wanted;
                    sums[region][1] += own * wanted;
                }
            }
        }
        sums.iter()
            .zip(&areas)
            .map(|(sums, area)| sums.map(|sum| sum / area))
            .collect()
    }

    #[test]
    fn contrasts_are_those_of_the_definition() {
        let [a, b] = images();
        let mask: Vec<bool> = (0..SHAPE.height * SHAPE.width)
            .map(|i| i % 7 != 2)
            .collect();
        for mask in [None, Some(&mask[..])] {
            let found = Compared::new(&a, &b, SHAPE, mask).unwrap().contrasts();
            for (found, want) in found.iter().zip(naive(&a, &b, mask)) {
                for k in 0..2 {
                    assert!((found[k] - want[k]).abs() < 1e-5, "{found:?} {want:?}");
                }
            }
        }
    }

    #[test]
    fn sums_of_steps_do_not_depend_on_threads_or_instructions() {
        let [a, b] = images();
        let compared = Compared::new(&a, &b, SHAPE, None).unwrap();
        let found = (compared.steps(), compared.contrasts());
        for threads in [1, 2, 8] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            assert_eq!(
                pool.install(|| (compared.steps(), compared.contrasts())),
                found
            );
        }
        let rows = || RowSteps {
            own: [&a[..50], &a[50..100]],
            wanted: [&b[..50], &b[50..100]],
        };
        let portable = rows().run::<crate::raster::simd::Portable>();
        for isa in Isa::available() {
            assert_eq!(dispatch(isa, rows()), portable, "{isa:?}");
        }
    }
}
