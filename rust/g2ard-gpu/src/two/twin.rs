//! The functions of two.wgsl, operation by operation, in strict f32 on the CPU: without fused operations, and with
//! divisions, square roots and subnormals as the least accurate device may compute them.

use std::cell::Cell;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// What WGSL leaves to the device.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// Subnormal operands and results are zero.
    pub flush: bool,
    /// Largest error of a quotient and of a square root, in units in the last place; ½ is correct rounding.
    pub quotient: f64,
    pub root: f64,
}

/// IEEE arithmetic, as on lavapipe.
pub const EXACT: Rules = Rules {
    flush: false,
    quotient: 0.5,
    root: 0.5,
};

/// IEEE arithmetic without subnormals.
pub const FLUSHED: Rules = Rules {
    flush: true,
    ..EXACT
};

/// The least that WGSL asks for: 2.5 units for a quotient, and a square root that is the inverse of an inverse root.
pub const WORST: Rules = Rules {
    flush: true,
    quotient: 2.5,
    root: 4.5,
};

thread_local! {
    static RULES: Cell<Rules> = const { Cell::new(EXACT) };
}

/// Compute by some rules.
pub fn by<T>(rules: Rules, compute: impl FnOnce() -> T) -> T {
    let before = RULES.replace(rules);
    let found = compute();
    RULES.set(before);
    found
}

/// A number of the device.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct Float(pub f32);

impl Float {
    fn kept(x: f32) -> Self {
        let flushed = RULES.get().flush && x.is_subnormal();
        Self(if flushed { 0f32.copysign(x) } else { x })
    }

    /// `exact`, rounded with an error of up to `most` units that looks random.
    fn within(exact: f64, most: f64) -> Self {
        let rounded = exact as f32;
        if most <= 0.5 || !rounded.is_normal() {
            return Self::kept(rounded);
        }
        let unit = f64::from(rounded.abs().next_up()) - f64::from(rounded.abs());
        let hash = (rounded.to_bits() ^ exact.to_bits() as u32).wrapping_mul(0x9e37_79b9) >> 8;
        let share = f64::from(hash) / f64::from(1 << 23) - 1.0;
        Self::kept((exact + share * (most - 0.5) * unit) as f32)
    }

    fn high(self) -> Self {
        Self(f32::from_bits(self.0.to_bits() & 0xffff_f000))
    }

    fn root(self) -> Self {
        Self::within(f64::from(self.0).sqrt(), RULES.get().root)
    }

    fn abs(self) -> Self {
        Self(self.0.abs())
    }

    fn max(self, other: Self) -> Self {
        Self(self.0.max(other.0))
    }
}

impl Add for Float {
    type Output = Self;
    fn add(self, b: Self) -> Self {
        Self::kept(Self::kept(self.0).0 + Self::kept(b.0).0)
    }
}

impl Sub for Float {
    type Output = Self;
    fn sub(self, b: Self) -> Self {
        self + -b
    }
}

impl Mul for Float {
    type Output = Self;
    fn mul(self, b: Self) -> Self {
        Self::kept(Self::kept(self.0).0 * Self::kept(b.0).0)
    }
}

impl Div for Float {
    type Output = Self;
    fn div(self, b: Self) -> Self {
        let exact = f64::from(Self::kept(self.0).0) / f64::from(Self::kept(b.0).0);
        Self::within(exact, RULES.get().quotient)
    }
}

impl Neg for Float {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Two(pub Float, pub Float);

impl Neg for Two {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0, -self.1)
    }
}

pub const ZERO: Two = Two(Float(0.0), Float(0.0));
pub const ONE: Two = Two(Float(1.0), Float(0.0));
const HALF: Float = Float(0.5);

pub fn ordered_sum(a: Float, b: Float) -> Two {
    let s = a + b;
    Two(s, b - (s - a))
}

pub fn exact_sum(a: Float, b: Float) -> Two {
    let s = a + b;
    let from_b = s - a;
    Two(s, (a - (s - from_b)) + (b - from_b))
}

pub fn exact_product(a: Float, b: Float) -> Two {
    let p = a * b;
    let (ah, bh) = (a.high(), b.high());
    let (al, bl) = (a - ah, b - bh);
    Two(p, ((ah * bh - p) + ah * bl) + al * bh + al * bl)
}

pub fn single(x: Float) -> Two {
    Two(x, Float(0.0))
}

pub fn add(a: Two, b: Two) -> Two {
    let s = exact_sum(a.0, b.0);
    ordered_sum(s.0, s.1 + (a.1 + b.1))
}

pub fn sub(a: Two, b: Two) -> Two {
    add(a, -b)
}

pub fn mul(a: Two, b: Two) -> Two {
    let p = exact_product(a.0, b.0);
    ordered_sum(p.0, p.1 + (a.0 * b.1 + a.1 * b.0))
}

fn rest(a: Float, p: Two) -> Float {
    (a - p.0) - p.1
}

pub fn div(a: Two, b: Two) -> Two {
    let mut q = a.0 / b.0;
    q = q + rest(a.0, exact_product(q, b.0)) / b.0;
    ordered_sum(q, sub(a, mul(b, single(q))).0 / b.0)
}

pub fn root(a: Two) -> Two {
    if a.0.0 <= 0.0 {
        return ZERO;
    }
    let mut r = a.0.root();
    r = r + HALF * rest(a.0, exact_product(r, r)) / r;
    ordered_sum(r, HALF * sub(a, exact_product(r, r)).0 / r)
}

pub fn lt(a: Two, b: Two) -> bool {
    a.0 < b.0 || (a.0 == b.0 && a.1 < b.1)
}

pub fn mag(a: Two) -> Two {
    if a.0.0 < 0.0 { -a } else { a }
}

fn double(a: Two) -> Two {
    Two(Float(2.0) * a.0, Float(2.0) * a.1)
}

fn power_of_two(e: i32) -> Float {
    Float(f32::from_bits(((e.clamp(-126, 127) + 127) as u32) << 23))
}

/// `scaled(difference(a, b), e)`.
pub fn scaled(a: i64, b: i64, e: i32) -> Two {
    let d = a.wrapping_sub(b);
    let n = d.unsigned_abs();
    let count = 64 - n.leading_zeros() as i32;
    let n = n.checked_shl(64 - count as u32).unwrap_or(0);
    let high = Float((n >> 40) as f32) * power_of_two(count - 24 + e);
    let low = Float((n >> 16 & 0xff_ffff) as f32) * power_of_two(count - 48 + e);
    let sum = ordered_sum(high, low);
    if d < 0 { -sum } else { sum }
}

/// Values, and their vectors.
pub type Eigen = ([Two; 3], [[Two; 3]; 3]);

pub fn symmetric_eigen(m: [Two; 6]) -> Eigen {
    let vanishing = Float(2.8e-17);
    let tiny = Float(1e-36);
    let mut a = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]];
    let mut v = [[ONE, ZERO, ZERO], [ZERO, ONE, ZERO], [ZERO, ZERO, ONE]];
    for step in 0..48 {
        let turn = step % 3;
        if turn == 0 && [a[0][1], a[0][2], a[1][2]].iter().all(|x| x.0.0 == 0.0) {
            break;
        }
        let p = usize::from(turn == 2);
        let q = if turn == 0 { 1 } else { 2 };
        let r = 3 - p - q;
        let apq = a[p][q];
        a[p][q] = ZERO;
        a[q][p] = ZERO;
        let beside = vanishing * a[p][p].0.abs().max(a[q][q].0.abs());
        if apq.0.abs() <= tiny.max(beside) {
            continue;
        }
        let theta = div(sub(a[q][q], a[p][p]), double(apq));
        let by = add(mag(theta), root(add(mul(theta, theta), ONE)));
        let sign = if theta.0.0 < 0.0 { -ONE } else { ONE };
        let t = div(sign, by);
        let c = div(ONE, root(add(mul(t, t), ONE)));
        let s = mul(t, c);
        let shift = mul(t, apq);
        a[p][p] = sub(a[p][p], shift);
        a[q][q] = add(a[q][q], shift);
        let turned = |x, y| (sub(mul(c, x), mul(s, y)), add(mul(s, x), mul(c, y)));
        for i in 0..3 {
            (v[p][i], v[q][i]) = turned(v[p][i], v[q][i]);
        }
        (a[r][p], a[r][q]) = turned(a[r][p], a[r][q]);
        (a[p][r], a[q][r]) = (a[r][p], a[r][q]);
    }
    let mut order = [0, 1, 2];
    for at in [0, 1, 0] {
        let [x, y] = [order[at], order[at + 1]];
        if lt(a[x][x], a[y][y]) {
            order.swap(at, at + 1);
        }
    }
    (order.map(|k| a[k][k]), order.map(|k| v[k]))
}
