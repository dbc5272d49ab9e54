//! The two-float functions against exact numbers: as a twin in strict f32 on every machine, and on a device, which must
//! give the twin's bits.

use super::twin::{self, EXACT, FLUSHED, Float, Rules, Two, WORST, by};
use super::*;
use crate::runtime::{Gpu, Kernel, Work};
use crate::testing::gpu;
use g2ard_core::linalg::{outer, symmetric_eigen};
use g2ard_core::random::Lcg;

/// Largest relative error of an operation, in terms of the larger operand: slightly over 2⁻⁴⁵.
const DIGITS: f64 = 3e-14;

/// The same for quotients and roots, whose last correction is divided by the device.
const QUOTIENT_DIGITS: f64 = 4e-14;

/// Differences this small do not count.
const TINY: f64 = 1e-31;

const RULES: [Rules; 3] = [EXACT, FLUSHED, WORST];

/// A number in the layout that kernels read.
fn two(x: f64) -> Two {
    let high = x as f32;
    Two(Float(high), Float((x - f64::from(high)) as f32))
}

fn value(x: Two) -> f64 {
    f64::from(x.0.0) + f64::from(x.1.0)
}

fn words(x: Two) -> [u32; 2] {
    [x.0.0.to_bits(), x.1.0.to_bits()]
}

/// Run `body`, which writes `out` numbers from `found[to]` on, for each of some rows of type `row`: its number is i.
fn answers<T: bytemuck::NoUninit>(
    gpu: &Gpu,
    [name, row, body]: [&'static str; 3],
    input: &[T],
    [rows, out]: [usize; 2],
) -> Vec<Two> {
    let source = format!(
        "@group(0) @binding(0) var<uniform> zero: vec4<u32>;
        @group(0) @binding(1) var<storage, read> rows: array<{row}>;
        @group(0) @binding(2) var<storage, read_write> found: array<Two>;

        @compute @workgroup_size(64)
        fn each(@builtin(global_invocation_id) id: vec3<u32>) {{
            hidden = zero.x;
            if id.x >= arrayLength(&rows) {{ return; }}
            let to = {out}u * id.x;
            let row = rows[id.x];
            {body}
        }}"
    );
    let sources = Vec::leak(vec![TWO, String::leak(source)]);
    let kernel = Kernel::new(name, sources, "each");
    let input = gpu.upload("input", input).unwrap();
    let found = gpu.buffer("found", 2 * out * rows).unwrap();
    let mut work = Work::new(gpu);
    let buffers = [&input, &found];
    work.run(&kernel, rows.div_ceil(64), &[0], &buffers)
        .unwrap();
    let words = work.submit(&[(&found, 2 * out * rows)]).unwrap().take();
    let number = |w: &[u32]| Two(Float(f32::from_bits(w[0])), Float(f32::from_bits(w[1])));
    words.unwrap()[0].chunks(2).map(number).collect()
}

/// Check that a device gives the twin's bits. Zeros may differ in their sign, and tiny numbers in digits whose errors are
/// subnormal, which a device may flush.
fn assert_same_bits(what: &str, got: &[Two], want: &[Two]) {
    assert_eq!(got.len(), want.len());
    let differ = got
        .iter()
        .zip(want)
        .filter(|(a, b)| a != b && (value(**a) - value(**b)).abs() > TINY);
    let differ: Vec<_> = differ.map(|(&a, &b)| (words(a), words(b))).collect();
    let first = &differ[..differ.len().min(3)];
    assert!(
        differ.is_empty(),
        "{what}: {} of {} differ: {first:x?}",
        differ.len(),
        got.len()
    );
}

/// A compiler that regroups sums can hide a wrong order, so the source must leave it nothing to regroup: each sum, and each
/// product and quotient that rounds, is alone in a call of `opaque`.
#[test]
fn every_operation_that_rounds_is_opaque() {
    let (from, to) = (TWO.find("fn plus").unwrap(), TWO.find("fn lt").unwrap());
    let mut bare = Vec::new();
    for line in TWO[from..to].lines() {
        let mut code = line.split("//").next().unwrap().to_owned();
        while let Some(at) = code.find("opaque(") {
            let mut depth = 0;
            let inner = code[at..].find(|c| {
                depth += i32::from(c == '(') - i32::from(c == ')');
                c == ')' && depth == 0
            });
            let call = code[at..=at + inner.unwrap()].to_owned();
            let count = |operator: &str| call.matches(operator).count();
            assert!(count(" + ") + count(" - ") + count(" / ") <= 1, "{line}");
            code = code.replace(&call, "hidden");
        }
        let operators = [" + ", " - ", " * ", " / "];
        if operators.iter().any(|operator| code.contains(operator)) {
            bare.push(code.trim().to_owned());
        }
    }
    // These are exact.
    let exact = ["= vec2(a, b) - high;", "0.5 * rest(", "0.5 * sub("];
    assert_eq!(bare.len(), exact.len(), "{bare:#?}");
    for (line, exact) in bare.iter().zip(exact) {
        assert!(line.contains(exact), "{line}");
    }
}

/// Random f32 of one power of two, and those whose halves are extreme.
fn significands() -> Vec<f32> {
    let mut random = Lcg(8);
    let mut found: Vec<f32> = (0..1000).map(|_| (1.0 + random.uniform()) as f32).collect();
    let ends = [0, 1, 0x7ff, 0x800, 0x801, 0xffe, 0xfff];
    for high in ends {
        let all = ends.map(|low| f32::from_bits(0x3f80_0000 | high << 11 & 0x7f_f000 | low));
        found.extend(all);
    }
    found
}

#[test]
fn products_are_exact() {
    let numbers = significands();
    for (i, &a) in numbers.iter().enumerate() {
        for (k, &b) in numbers.iter().enumerate() {
            let a = if (i ^ k) & 1 == 0 { a } else { -a };
            let b = b * 2f32.powi(k as i32 % 60 - 30);
            let exact = f64::from(a) * f64::from(b);
            let got = value(twin::exact_product(Float(a), Float(b)));
            assert!(got == exact, "{a:e} {b:e}");
        }
    }
}

/// The cross products' sum needs 25 bits, so it must not come first.
#[test]
fn another_order_of_a_products_sums_loses_digits() {
    let mut random = Lcg(9);
    let (mut wrong, mut worst, count) = (0, 0f64, 200_000);
    for _ in 0..count {
        let [a, b] = [0; 2].map(|_| random.uniform() as f32);
        let high = [a, b].map(|x| f32::from_bits(x.to_bits() & 0xffff_f000));
        let low = [a - high[0], b - high[1]];
        let p = a * b;
        let cross = high[0] * low[1] + low[0] * high[1];
        let lost = ((high[0] * high[1] - p) + cross) + low[0] * low[1];
        let exact = f64::from(a) * f64::from(b);
        let apart = (f64::from(p) + f64::from(lost) - exact).abs() / exact;
        wrong += usize::from(apart > 0.0);
        worst = worst.max(apart);
    }
    let share = wrong as f64 / f64::from(count);
    eprintln!("{:.1} % wrong, by up to {worst:.1e}", 100.0 * share);
    assert!((0.080..0.091).contains(&share), "{share}");
    assert!(worst > 100.0 * DIGITS, "{worst:e}");
}

#[test]
fn sums_are_exact() {
    let mut random = Lcg(10);
    for _ in 0..200_000 {
        let a = random.centred() as f32;
        let b = random.centred() as f32 * 2f32.powi(random.below(49) as i32 - 24);
        let (exact, lesser) = (f64::from(a) + f64::from(b), a.abs().min(b.abs()));
        assert!(value(twin::exact_sum(Float(a), Float(b))) == exact);
        let ordered = twin::ordered_sum(
            Float(if lesser == a.abs() { b } else { a }),
            Float(if lesser == a.abs() { a } else { b }),
        );
        assert!(value(ordered) == exact);
    }
}

/// Pairs of numbers; every third pair nearly cancels.
fn operands() -> Vec<Two> {
    let mut random = Lcg(3);
    let mut numbers: Vec<f64> = (0..200_000)
        .map(|i| {
            let wide = [0, 0, 3, 12][i % 4];
            let power = random.below(2 * wide + 1) as i32 - wide as i32;
            let x = random.centred() * 2f64.powi(power);
            if i % 7 == 0 { x + 1.0 } else { x }
        })
        .collect();
    for i in (0..numbers.len()).step_by(6) {
        numbers[i + 1] = -numbers[i] * (1.0 + 1e-9);
    }
    numbers.into_iter().map(two).collect()
}

/// The results of `OPERATIONS`.
fn operations(pair: &[Two]) -> [Two; 5] {
    let [a, b] = [pair[0], pair[1]];
    let root = twin::root(twin::mag(a));
    [
        twin::add(a, b),
        twin::sub(a, b),
        twin::mul(a, b),
        twin::div(a, b),
        root,
    ]
}

fn assert_operations_keep_their_digits(pairs: &[Two], found: &[Two]) {
    for (pair, got) in pairs.chunks(2).zip(found.chunks(5)) {
        let [a, b] = [value(pair[0]), value(pair[1])];
        let want = [a + b, a - b, a * b, a / b, a.abs().sqrt()];
        let larger = a.abs().max(b.abs());
        for (k, (got, want)) in got.iter().zip(want).enumerate() {
            let beside = if k < 2 { larger } else { want.abs() };
            let apart = (value(*got) - want).abs();
            let digits = if k < 3 { DIGITS } else { QUOTIENT_DIGITS };
            assert!(apart <= digits * beside, "{k}: {a:e} {b:e}: {apart:e}");
        }
    }
}

const OPERATIONS: [&str; 3] = [
    "test.operations",
    "vec4<f32>",
    "let a = row.xy;
    let b = row.zw;
    found[to] = add(a, b);
    found[to + 1u] = sub(a, b);
    found[to + 2u] = mul(a, b);
    found[to + 3u] = div(a, b);
    found[to + 4u] = root(mag(a));",
];

#[test]
fn operations_keep_their_digits() {
    let pairs = operands();
    for rules in RULES {
        let found: Vec<_> = by(rules, || pairs.chunks(2).flat_map(operations).collect());
        assert_operations_keep_their_digits(&pairs, &found);
    }
}

#[test]
fn operations_on_a_device_are_the_twins() {
    let Some(gpu) = gpu() else { return };
    let pairs = operands();
    let input: Vec<_> = pairs.iter().map(|&x| words(x)).collect();
    let found = answers(&gpu, OPERATIONS, &input, [pairs.len() / 2, 5]);
    assert_operations_keep_their_digits(&pairs, &found);
    let want: Vec<_> = pairs.chunks(2).flat_map(operations).collect();
    for (k, what) in ["sum", "difference", "product", "quotient", "root"]
        .iter()
        .enumerate()
    {
        // Other devices divide with their own rounding.
        if k < 3 || gpu.adapter.is_software() {
            let every = |all: &[Two]| all.iter().skip(k).step_by(5).copied().collect::<Vec<_>>();
            assert_same_bits(what, &every(&found), &every(&want));
        }
    }
}

/// Pairs of 64-bit integers of every length.
fn integers() -> Vec<i64> {
    let mut random = Lcg(4);
    let number = |i| ((random.centred() * 2f64.powi(62)) as i64) >> (i / 2 % 60);
    (0..20_000).map(number).collect()
}

const POWER: i32 = -50;
const DIFFERENCES: [&str; 3] = [
    "test.differences",
    "vec4<u32>",
    "found[to] = scaled(difference(row.xy, row.zw), -50);",
];

fn assert_differences_keep_their_digits(numbers: &[i64], found: &[Two]) {
    for (pair, &got) in numbers.chunks(2).zip(found) {
        let want = (pair[0] - pair[1]) as f64 * 2f64.powi(POWER);
        assert!((value(got) - want).abs() <= DIGITS * want.abs(), "{pair:?}");
    }
}

fn differences(numbers: &[i64]) -> Vec<Two> {
    let pairs = numbers.chunks(2);
    pairs.map(|n| twin::scaled(n[0], n[1], POWER)).collect()
}

#[test]
fn differences_keep_their_digits() {
    let numbers = integers();
    assert_differences_keep_their_digits(&numbers, &differences(&numbers));
}

#[test]
fn differences_on_a_device_are_the_twins() {
    let Some(gpu) = gpu() else { return };
    let numbers = integers();
    let found = answers(&gpu, DIFFERENCES, &numbers, [numbers.len() / 2, 1]);
    assert_differences_keep_their_digits(&numbers, &found);
    assert_same_bits("differences", &found, &differences(&numbers));
}

fn matrices() -> Vec<[f64; 6]> {
    let mut random = Lcg(5);
    let mut matrices = vec![[0.0; 6], [1.0, 0.0, 0.0, 3.0, 0.0, 2.0], [1.0; 6]];
    for i in 0..3000 {
        let flat = [1.0, 1e-4, 1e-9, 0.0][i % 4];
        let mut next = |scale: f64| random.centred() * scale;
        let (d, e) = (
            outer([next(1.0), next(flat), next(flat)]),
            outer([next(1.0), next(1.0), next(flat)]),
        );
        matrices.push([0, 1, 2, 3, 4, 5].map(|k| d[k] + e[k]));
    }
    matrices
}

const EIGENS: [&str; 3] = [
    "test.eigens",
    "array<Two, 6>",
    "let e = symmetric_eigen(row);
    for (var k = 0u; k < 3u; k++) {
        found[to + k] = e.values[k];
        for (var j = 0u; j < 3u; j++) { found[to + 3u + 3u * k + j] = e.vectors[k][j]; }
    }",
];

fn eigens(matrix: &[f64; 6]) -> Vec<Two> {
    let (values, vectors) = twin::symmetric_eigen(matrix.map(two));
    [&values, vectors.as_flattened()].concat()
}

fn assert_eigenvectors_belong_to_their_values(matrices: &[[f64; 6]], found: &[Two]) {
    for (m, got) in matrices.iter().zip(found.chunks(12)) {
        let got: Vec<f64> = got.iter().map(|&x| value(x)).collect();
        let want = symmetric_eigen(m);
        let size = want.values[0].abs();
        let mut back = [0.0; 6];
        for k in 0..3 {
            let apart = (got[k] - want.values[k]).abs();
            assert!(apart <= 10.0 * DIGITS * size, "{m:?}: {apart:e}");
            let axis = outer([0, 1, 2].map(|j| got[3 + 3 * k + j]));
            (0..6).for_each(|i| back[i] += got[k] * axis[i]);
        }
        for i in 0..6 {
            let apart = (back[i] - m[i]).abs();
            assert!(apart <= 10.0 * DIGITS * size, "{m:?}: {apart:e}");
        }
    }
}

#[test]
fn eigenvectors_belong_to_their_values() {
    let matrices = matrices();
    for rules in RULES {
        let found: Vec<_> = by(rules, || matrices.iter().flat_map(eigens).collect());
        assert_eigenvectors_belong_to_their_values(&matrices, &found);
    }
}

#[test]
fn eigenvectors_on_a_device_are_the_twins() {
    let Some(gpu) = gpu() else { return };
    let matrices = matrices();
    let input: Vec<_> = matrices
        .as_flattened()
        .iter()
        .map(|&x| words(two(x)))
        .collect();
    let found = answers(&gpu, EIGENS, &input, [matrices.len(), 12]);
    assert_eigenvectors_belong_to_their_values(&matrices, &found);
    if gpu.adapter.is_software() {
        let want: Vec<_> = matrices.iter().flat_map(eigens).collect();
        assert_same_bits("eigenvectors", &found, &want);
    }
}
