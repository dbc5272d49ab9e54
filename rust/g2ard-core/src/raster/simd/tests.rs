use super::*;

/// Runs one lane function over many rows of inputs.
struct Over<'a>(&'a [f32], &'static str);

impl Kernel for Over<'_> {
    type Output = Vec<f32>;
    #[inline(always)]
    fn run<F: Lanes>(self) -> Vec<f32> {
        let mut out = Vec::new();
        for chunk in self.0.chunks_exact(LANES) {
            let mut row = Lanes16::default();
            row.0.copy_from_slice(chunk);
            let x = F::load(&row);
            let y = match self.1 {
                "exp2" => x.exp2(),
                "exp" => x.exp(),
                "log2_1p" => x.log2_1p(),
                "recip" => x.recip(),
                "floor" => x.floor(),
                _ => F::narrow(x.widen() * F::Wide::splat(2.0)),
            };
            y.store(&mut row);
            out.extend(row.0);
        }
        out
    }
}

fn worst(isa: Isa, name: &'static str, from: f64, to: f64, exact: impl Fn(f64) -> f64) -> f64 {
    let x: Vec<f32> = (0..160_000)
        .map(|i| (from + (to - from) * f64::from(i) / 160_000.0) as f32)
        .collect();
    let y = dispatch(isa, Over(&x, name));
    let error = |(x, y): (&f32, &f32)| {
        let e = exact(f64::from(*x));
        (f64::from(*y) - e).abs() / e.abs().max(1e-30)
    };
    x.iter().zip(&y).map(error).fold(0.0, f64::max)
}

#[test]
fn functions_are_accurate() {
    for isa in Isa::available() {
        assert!(worst(isa, "exp2", -40.0, 20.0, f64::exp2) < 2.3e-7);
        assert!(worst(isa, "exp", -80.0, 80.0, f64::exp) < 3e-7);
        assert!(
            worst(isa, "log2_1p", 1e-6, 1.0, |x| x.ln_1p()
                / std::f64::consts::LN_2)
                < 3e-7
        );
        assert!(worst(isa, "recip", 0.001, 2.0, |x| 1.0 / x) < 1.5e-7);
        assert!(worst(isa, "floor", -30.0, 30.0, f64::floor) == 0.0);
        assert!(worst(isa, "double", -30.0, 30.0, |x| 2.0 * x) == 0.0);
    }
}

struct Sums<'a>(&'a [Lanes16; 10]);

impl Kernel for Sums<'_> {
    type Output = (Lanes16, u16, u16);
    #[inline(always)]
    fn run<F: Lanes>(self) -> (Lanes16, u16, u16) {
        let mut rows = [F::zero(); 10];
        for k in 0..10 {
            rows[k] = F::load(&self.0[k]);
        }
        let above = rows[1].gt(rows[0]);
        let odd = F::Mask::from_bits(0b1010_1010_1010_1010);
        (
            F::sums(&rows),
            above.and(odd).bits(),
            above.and_not(odd).bits(),
        )
    }
}

#[test]
fn sums_and_masks_keep_their_places() {
    let mut rows = [Lanes16::default(); 10];
    for (k, row) in rows.iter_mut().enumerate() {
        for l in 0..LANES {
            row.0[l] = ((k * 37 + l * 11) % 23) as f32 - 7.0;
        }
    }
    for isa in Isa::available() {
        let (sums, odd, even) = dispatch(isa, Sums(&rows));
        for k in 0..10 {
            assert_eq!(
                sums.0[k],
                rows[k].0.iter().sum::<f32>(),
                "{} row {k}",
                isa.name()
            );
        }
        for l in 0..LANES {
            let above = rows[1].0[l] > rows[0].0[l];
            assert_eq!(odd >> l & 1 == 1, above && l % 2 == 1);
            assert_eq!(even >> l & 1 == 1, above && l % 2 == 0);
        }
    }
}

/// Results of every lane operation for a and b, in bits.
struct Operations<'a>(&'a Lanes16, &'a Lanes16);

impl Kernel for Operations<'_> {
    type Output = Vec<(&'static str, [u32; LANES])>;

    #[inline(always)]
    fn run<F: Lanes>(self) -> Self::Output {
        let (a, b) = (F::load(self.0), F::load(self.1));
        let (ge, gt) = (a.ge(b), a.gt(b));
        let small = F::select(F::splat(1e9).gt(a.abs()), a, F::splat(-2.5)); // `floor` may go through i32
        let power = b.max(F::splat(-20.0)).min(F::splat(20.0)).floor();
        let masks = [ge, gt, ge.and(gt), ge.or(gt), ge.and_not(gt)];
        let mut out: Self::Output = [
            ("add", a + b),
            ("sub", a - b),
            ("mul", a * b),
            ("div", a / b),
            ("neg", -a),
            ("min", a.min(b)),
            ("max", a.max(b)),
            ("sqrt", a.sqrt()),
            ("floor", small.floor() + F::zero()), // through i32 the sign of −0 is lost
            ("ldexp", F::splat(1.25).ldexp(power)),
            ("select", F::select(gt, a, b)),
            ("only", a.only(ge)),
            ("wide add", F::narrow(a.widen() + b.widen())),
            ("wide mul", F::narrow(a.widen() * b.widen())),
            ("wide div", F::narrow(a.widen() / b.widen())),
        ]
        .into_iter()
        .map(|(name, value)| (name, stored(value)))
        .collect();
        for (name, mask) in ["ge", "gt", "and", "or", "and_not"].into_iter().zip(masks) {
            let back = F::splat(1.0).only(F::Mask::from_bits(mask.bits()));
            assert_eq!(stored(F::splat(1.0).only(mask)), stored(back));
            assert_eq!(mask.any(), mask.bits() != 0);
            out.push((name, [u32::from(mask.bits()); LANES]));
        }
        out
    }
}

#[inline(always)]
fn stored<F: Lanes>(value: F) -> [u32; LANES] {
    let mut row = Lanes16::default();
    value.store(&mut row);
    row.0.map(|v| {
        if v.is_nan() {
            f32::NAN.to_bits()
        } else {
            v.to_bits()
        }
    })
}

/// Rows of ordinary, tiny, huge and special values.
fn rows_of_values() -> Vec<Lanes16> {
    const SPECIAL: [f32; 14] = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::NAN,
        f32::MIN_POSITIVE,
        -1e-40,
        f32::MAX,
        f32::MIN,
        0.5,
        -3.75,
        16_777_217.0,
    ];
    let mut state = 7u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 8
    };
    let mut row = || {
        let mut row = Lanes16::default();
        for value in &mut row.0 {
            let drawn = next();
            *value = if drawn % 4 == 0 {
                SPECIAL[next() as usize % SPECIAL.len()]
            } else {
                (drawn as f32 / 16_777_216.0 - 0.5) * 10f32.powi(next() as i32 % 9 - 4)
            };
        }
        row
    };
    (0..2000).map(|_| row()).collect()
}

#[test]
fn every_set_gives_the_portable_bits() {
    for pair in rows_of_values().windows(2) {
        let expected = dispatch(Isa::Portable, Operations(&pair[0], &pair[1]));
        for isa in Isa::available() {
            let found = dispatch(isa, Operations(&pair[0], &pair[1]));
            for (found, expected) in found.iter().zip(&expected) {
                assert_eq!(found, expected, "{}: {pair:?}", isa.name());
            }
        }
    }
}

struct Fused<'a>(&'a [Lanes16]);

impl Kernel for Fused<'_> {
    type Output = ([u32; LANES], [u32; LANES]);

    #[inline(always)]
    fn run<F: Lanes>(self) -> Self::Output {
        let [a, b, c] = [0, 1, 2].map(|k| F::load(&self.0[k]));
        (stored(a.fma(b, c)), stored(a.fnma(b, c)))
    }
}

#[test]
fn products_are_fused_where_the_set_can() {
    for three in rows_of_values().windows(3) {
        let [a, b, c] = [three[0].0, three[1].0, three[2].0];
        for isa in Isa::available() {
            if isa == Isa::Portable && !cfg!(target_arch = "aarch64") {
                continue; // without the instruction the portable lanes round twice
            }
            let (fma, fnma) = dispatch(isa, Fused(three));
            for l in 0..LANES {
                let bits = |v: f32| {
                    if v.is_nan() {
                        f32::NAN.to_bits()
                    } else {
                        v.to_bits()
                    }
                };
                assert_eq!(fma[l], bits(a[l].mul_add(b[l], c[l])), "{}", isa.name());
                assert_eq!(fnma[l], bits((-a[l]).mul_add(b[l], c[l])), "{}", isa.name());
            }
        }
    }
}
