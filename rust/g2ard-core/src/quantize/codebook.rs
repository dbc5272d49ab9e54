//! The `count` numbers that stand for many with the least squared error.

use rayon::prelude::*;

use crate::Result;

/// More distinct values than this are merged into at most twice as many bins; fewer are kept separate.
const BINS: usize = 4096;

/// Sums over the bins before each one, of values from which a centre was taken.
struct Sums {
    weight: Vec<f64>,
    first: Vec<f64>,
    second: Vec<f64>,
    centre: f64,
}

impl Sums {
    fn bins(&self) -> usize {
        self.weight.len() - 1
    }

    /// Σ w (v − mean)² over the bins from `low` to before `high`.
    fn error(&self, low: usize, high: usize) -> f64 {
        let weight = self.weight[high] - self.weight[low];
        if weight <= 0.0 {
            return 0.0;
        }
        let first = self.first[high] - self.first[low];
        (self.second[high] - self.second[low] - first * first / weight).max(0.0)
    }

    fn mean(&self, low: usize, high: usize) -> f32 {
        let weight = self.weight[high] - self.weight[low];
        let first = self.first[high] - self.first[low];
        (self.centre + if weight > 0.0 { first / weight } else { 0.0 }) as f32
    }
}

/// `count` ascending numbers with the least Σ w (v − nearest)²: exact 1-D clustering by dynamic programming.
///
/// The best last cluster begins the later the more bins there are, so a layer is filled by halving. The last
/// number is repeated where there are fewer distinct values. Beyond 4,096 distinct values, neighbours share
/// a bin: those within 1/4096 of the range, taken through
/// asinh so that strays do not widen all bins, *and* of the weight.
///
/// # Errors
///
/// No value, a value or weight that is not finite, a negative weight, or `count` of 0 or over 65,536.
pub fn codebook(values: &[f32], weights: Option<&[f32]>, count: usize) -> Result<Vec<f32>> {
    check(values, weights, count)?;
    let sums = binned(values, weights);
    let bins = sums.bins();
    let clusters = count.min(bins);
    let mut best: Vec<f64> = (0..=bins).map(|high| sums.error(0, high)).collect();
    let mut starts: Vec<Vec<u16>> = Vec::with_capacity(clusters);
    starts.push(vec![0; bins + 1]);
    for k in 1..clusters {
        let mut next = best.clone();
        let mut start = vec![0; bins + 1];
        layer(&sums, &best, &mut next, &mut start, k, bins);
        best = next;
        starts.push(start);
    }
    let mut out = Vec::with_capacity(count);
    let mut high = bins;
    for start in starts.iter().rev() {
        let low = usize::from(start[high]);
        out.push(sums.mean(low, high));
        high = low;
    }
    out.reverse();
    out.resize(count, *out.last().unwrap_or(&0.0));
    Ok(out)
}

fn check(values: &[f32], weights: Option<&[f32]>, count: usize) -> Result<()> {
    refuse!(values.is_empty() => "values", "at least one", 0);
    refuse!(count == 0 || count > 1 << 16 => "count", "1 to 65536", count);
    super::palette::check_weights(weights, values.len())?;
    super::palette::check_finite("values", values, 1)
}

/// One layer of the dynamic programme: with k + 1 clusters, the start of the last one for every number of bins.
fn layer(sums: &Sums, best: &[f64], next: &mut [f64], start: &mut [u16], k: usize, bins: usize) {
    let mut stack = vec![(k + 1, bins, k, bins - 1)];
    while let Some((low, high, first, last)) = stack.pop() {
        if low > high {
            continue;
        }
        let middle = low.midpoint(high);
        let (mut least, mut at) = (f64::INFINITY, first);
        for split in first..=last.min(middle - 1) {
            let error = best[split] + sums.error(split, middle);
            if error < least {
                (least, at) = (error, split);
            }
        }
        next[middle] = least;
        start[middle] = at as u16;
        stack.push((low, middle - 1, first, at));
        stack.push((middle + 1, high, at, last));
    }
}

fn at_rank(sorted: &[(f32, f32)], share: f64) -> f64 {
    f64::from(sorted[((sorted.len() - 1) as f64 * share).round() as usize].0)
}

/// The values in order, equal and nearly equal ones together.
fn binned(values: &[f32], weights: Option<&[f32]>) -> Sums {
    let mut sorted: Vec<(f32, f32)> = match weights {
        Some(weights) => values
            .iter()
            .copied()
            .zip(weights.iter().copied())
            .collect(),
        None => values.iter().map(|&v| (v, 1.0)).collect(),
    };
    sorted.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let distinct = 1 + sorted.windows(2).filter(|w| w[0].0 != w[1].0).count();
    let total: f64 = sorted.iter().map(|v| f64::from(v.1)).sum();
    let [low, quarter, centre, three, high] =
        [0.0, 0.25, 0.5, 0.75, 1.0].map(|share| at_rank(&sorted, share));
    let unit = (three - quarter)
        .max((high - low) / 1e4)
        .max(f64::MIN_POSITIVE);
    let scaled = |v: f64| ((v - centre) / unit).asinh();
    let (first_place, last_place) = (scaled(low), scaled(high));
    let bins = BINS as f64;
    let mut out = Sums {
        weight: vec![0.0],
        first: vec![0.0],
        second: vec![0.0],
        centre,
    };
    let (mut weight, mut first, mut second, mut before) = (0.0, 0.0, 0.0, (0, 0));
    for (i, &(value, w)) in sorted.iter().enumerate() {
        if i > 0 && value != sorted[i - 1].0 {
            let along = (scaled(f64::from(value)) - first_place) / (last_place - first_place);
            let place = (along * bins) as u32;
            let share = (weight / total * bins) as u32;
            if distinct <= BINS || (place, share) != before {
                out.weight.push(weight);
                out.first.push(first);
                out.second.push(second);
                before = (place, share);
            }
        }
        let (v, w) = (f64::from(value) - centre, f64::from(w));
        weight += w;
        first += w * v;
        second += w * v * v;
    }
    out.weight.push(weight);
    out.first.push(first);
    out.second.push(second);
    out
}
