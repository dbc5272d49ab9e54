use super::*;
use crate::random::Lcg;
use crate::{Control, Error};

/// Σ w (v − nearest)².
fn error(values: &[f32], weights: &[f32], book: &[f32]) -> f64 {
    let nearest = |v: f32| {
        let gaps = book.iter().map(|b| f64::from(v) - f64::from(*b));
        gaps.map(|d| d * d).fold(f64::INFINITY, f64::min)
    };
    let all = values.iter().zip(weights);
    all.map(|(v, w)| f64::from(*w) * nearest(*v)).sum()
}

/// The least error of `count` numbers, by trying every cut of the sorted values.
fn least(values: &[f32], weights: &[f32], count: usize) -> f64 {
    let mut rows: Vec<(f64, f64)> = (values.iter().zip(weights))
        .map(|(v, w)| (f64::from(*v), f64::from(*w)))
        .collect();
    rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
    let own = |rows: &[(f64, f64)]| {
        let weight: f64 = rows.iter().map(|r| r.1).sum();
        let mean = rows.iter().map(|r| r.0 * r.1).sum::<f64>() / weight.max(1e-300);
        rows.iter().map(|r| r.1 * (r.0 - mean).powi(2)).sum::<f64>()
    };
    let mut best: Vec<f64> = (0..=rows.len()).map(|high| own(&rows[..high])).collect();
    for _ in 1..count {
        best = (0..=rows.len())
            .map(|high| {
                let cuts = (0..=high).map(|low| best[low] + own(&rows[low..high]));
                cuts.fold(f64::INFINITY, f64::min)
            })
            .collect();
    }
    best[rows.len()]
}

#[test]
fn codebooks_have_the_least_error() {
    let mut random = Lcg(21);
    for count in [1, 2, 3, 7] {
        for spread in [0.0, 1.0, 30.0] {
            let values: Vec<f32> = (0..60)
                .map(|i| (5.0 + spread * random.centred()) as f32 + (i % 3) as f32)
                .collect();
            let weights: Vec<f32> = (0..60)
                .map(|i| {
                    if i % 7 == 0 {
                        0.0
                    } else {
                        random.uniform_f32()
                    }
                })
                .collect();
            let book = codebook(&values, Some(&weights), count).unwrap();
            assert_eq!(book.len(), count);
            assert!(book.is_sorted());
            let (got, want) = (
                error(&values, &weights, &book),
                least(&values, &weights, count),
            );
            assert!(
                (got - want).abs() <= 1e-5 * want + 1e-9,
                "{count} {spread}: {got} {want}"
            );
        }
    }
}

#[test]
fn codebooks_of_many_values_are_nearly_the_best() {
    let mut random = Lcg(22);
    let values: Vec<f32> = (0..20_000).map(|_| random.centred() as f32).collect();
    let weights = vec![1.0; values.len()];
    let book = codebook(&values, None, 16).unwrap();
    // Of a uniform distribution on an interval of length 1, in n cells: 1/(12 n²).
    let got = error(&values, &weights, &book) / 20_000.0;
    assert!((got * 12.0 * 256.0 - 1.0).abs() < 0.05, "{got}");
}

/// Six tight groups of rows in 9 dimensions, group by group.
fn blobs() -> (Vec<f32>, Vec<f32>) {
    let mut random = Lcg(23);
    let mut values = Vec::new();
    for row in 0..240usize {
        for dim in 0..9 {
            let middle = if (row % 6 + dim) % 4 == 0 {
                10.0
            } else {
                -3.0 * (row % 6) as f32
            };
            values.push(middle + random.centred() as f32);
        }
    }
    (
        values,
        (0..240).map(|_| 0.1 + random.uniform_f32()).collect(),
    )
}

#[test]
fn palettes_find_separate_groups_and_their_weighted_means() {
    let (values, weights) = blobs();
    for steps in [0, 6] {
        let found = palette(&values, 9, Some(&weights), 6, steps, &Control::default()).unwrap();
        assert_eq!(found.entries.len(), 6 * 9);
        for group in 0..6 {
            let label = found.labels[group];
            let rows: Vec<usize> = (0..240).filter(|row| row % 6 == group).collect();
            assert!(
                rows.iter().all(|&row| found.labels[row] == label),
                "{group}"
            );
            let weight: f64 = rows.iter().map(|&row| f64::from(weights[row])).sum();
            for dim in 0..9 {
                let sum = |&row: &usize| f64::from(weights[row] * values[9 * row + dim]);
                let mean = rows.iter().map(sum).sum::<f64>() / weight;
                let got = f64::from(found.entries[9 * label as usize + dim]);
                assert!((got - mean).abs() < 1e-4, "{group} {dim}: {got} {mean}");
            }
        }
    }
}

#[test]
fn the_unit_of_the_weights_does_not_matter() {
    let (rows, weights) = blobs();
    let mut random = Lcg(24);
    let values: Vec<f32> = (0..9000).map(|_| random.centred() as f32).collect();
    let value_weights: Vec<f32> = (0..9000).map(|_| random.uniform_f32()).collect();
    let found = |unit: f32| {
        let scaled = |weights: &[f32]| -> Vec<f32> { weights.iter().map(|w| w * unit).collect() };
        let entries = palette(
            &rows,
            9,
            Some(&scaled(&weights)),
            12,
            4,
            &Control::default(),
        );
        let book = codebook(&values, Some(&scaled(&value_weights)), 64);
        (entries.unwrap(), book.unwrap())
    };
    let whole = found(1.0);
    for power in [-30, -12, 9] {
        assert_eq!(found(2f32.powi(power)), whole, "{power}");
    }
}

#[test]
fn palettes_end_on_values_of_any_magnitude() {
    let (values, weights) = blobs();
    for scale in [0.0, 1e-40, 1e-30, 1e-20, 1e18, 1e25, 3e37] {
        let scaled: Vec<f32> = values.iter().map(|v| v / 20.0 * scale).collect();
        for weights in [None, Some(&weights[..])] {
            let found = palette(&scaled, 9, weights, 12, 4, &Control::default()).unwrap();
            let entries = found.entries.len() / 9;
            assert!((1..=12).contains(&entries), "{scale:e}");
            assert!(found.entries.iter().all(|v| v.is_finite()), "{scale:e}");
            assert!(found.labels.iter().all(|&l| (l as usize) < entries));
            let book = codebook(&scaled, None, 5).unwrap();
            assert!(book.iter().all(|v| v.is_finite()), "{scale:e}");
        }
    }
}

#[test]
fn what_is_not_finite_is_named() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let values = [0.0, 1.0, 2.0, bad, 4.0, 5.0];
        let told = |error: Error| error.to_string();
        let found = palette(&values, 2, None, 2, 1, &Control::default()).map_err(told);
        assert!(found.unwrap_err().contains("row 1"));
        assert!(
            codebook(&values, None, 2)
                .map_err(told)
                .unwrap_err()
                .contains("row 3")
        );
        let weights = [1.0, bad.abs(), 1.0];
        let found = palette(&[0.0; 6], 2, Some(&weights), 2, 1, &Control::default());
        assert!(found.map_err(told).unwrap_err().contains("row 1"));
    }
    assert!(
        palette(
            &[1.0; 6],
            2,
            Some(&[1.0, -1.0, 1.0]),
            2,
            1,
            &Control::default()
        )
        .is_err()
    );
}

#[test]
fn neighbours_along_a_line_are_the_nearest() {
    let entries: Vec<f32> = (0..1500)
        .flat_map(|i| [i as f32 * 1.01, 0.25 * i as f32])
        .collect();
    let found = near::neighbors(&entries, 2);
    assert_eq!(found.len(), 1500);
    for (at, found) in found.iter().enumerate() {
        let mut want: Vec<usize> = (0..1500).filter(|&i| i != at).collect();
        want.sort_by_key(|&i| (i.abs_diff(at), i));
        let reach = want[near::NEIGHBORS - 1].abs_diff(at);
        assert_eq!(found.len(), near::NEIGHBORS);
        assert!(
            found
                .iter()
                .all(|&i| i as usize != at && (i as usize).abs_diff(at) <= reach + 1)
        );
        assert_eq!((found[0] as usize).abs_diff(at), 1);
    }
}
