// Numbers as sums of two f32, the second at most half the last digit of the first: about 46 bits.
//
// Compilers may fuse a product into a sum, reorder sums, or cancel a rounding error by algebra. Each operation that rounds
// therefore hides its result behind `opaque`, and every device computes the same bits. Only division and sqrt may
// differ, by a few units in the last place; `div` and `root` correct that. twin.rs repeats this file for tests.

alias Two = vec2<f32>;

const ZERO = Two(0.0, 0.0);
const ONE = Two(1.0, 0.0);

// Each kernel sets it to a constant of its dispatch that is 0.
var<private> hidden: u32;

fn opaque(x: f32) -> f32 { return bitcast<f32>(bitcast<u32>(x) ^ hidden); }

fn plus(a: f32, b: f32) -> f32 { return opaque(a + b); }
fn times(a: f32, b: f32) -> f32 { return opaque(a * b); }
fn over(a: f32, b: f32) -> f32 { return opaque(a / b); }

// a + b where |a| ≥ |b|.
fn ordered_sum(a: f32, b: f32) -> Two {
    let s = plus(a, b);
    return Two(s, plus(b, -plus(s, -a)));
}

fn exact_sum(a: f32, b: f32) -> Two {
    let s = plus(a, b);
    let from_b = plus(s, -a);
    return Two(s, plus(plus(a, -plus(s, -from_b)), plus(b, -from_b)));
}

// Dekker's product: in this order, every partial sum is exact.
fn exact_product(a: f32, b: f32) -> Two {
    let p = times(a, b);
    // Halves of 12 bits, whose products are exact, fused or not.
    let high = bitcast<vec2<f32>>(bitcast<vec2<u32>>(vec2(a, b)) & vec2(0xfffff000u));
    let low = vec2(a, b) - high;
    var lost = opaque(high.x * high.y - p);
    lost = opaque(lost + high.x * low.y);
    lost = opaque(lost + low.x * high.y);
    return Two(p, opaque(lost + low.x * low.y));
}

fn single(x: f32) -> Two { return Two(x, 0.0); }

fn add(a: Two, b: Two) -> Two {
    let s = exact_sum(a.x, b.x);
    return ordered_sum(s.x, plus(s.y, plus(a.y, b.y)));
}

fn sub(a: Two, b: Two) -> Two { return add(a, -b); }

fn mul(a: Two, b: Two) -> Two {
    let p = exact_product(a.x, b.x);
    return ordered_sum(p.x, plus(p.y, plus(times(a.x, b.y), times(a.y, b.x))));
}

// a − p where p is near a.
fn rest(a: f32, p: Two) -> f32 { return plus(plus(a, -p.x), -p.y); }

fn div(a: Two, b: Two) -> Two {
    var q = over(a.x, b.x);
    q = plus(q, over(rest(a.x, exact_product(q, b.x)), b.x));
    return ordered_sum(q, over(sub(a, mul(b, single(q))).x, b.x));
}

fn root(a: Two) -> Two {
    if !(a.x > 0.0) { return ZERO; }
    var r = opaque(sqrt(a.x));
    r = plus(r, over(0.5 * rest(a.x, exact_product(r, r)), r));
    return ordered_sum(r, over(0.5 * sub(a, exact_product(r, r)).x, r));
}

fn lt(a: Two, b: Two) -> bool { return a.x < b.x || (a.x == b.x && a.y < b.y); }
fn mag(a: Two) -> Two { return select(a, -a, a.x < 0.0); }
fn larger(a: Two, b: Two) -> Two { return select(a, b, lt(a, b)); }

// 2^e, with e cut to what f32 has.
fn power_of_two(e: i32) -> f32 { return bitcast<f32>(u32(clamp(e, -126, 127) + 127) << 23u); }

// a − b of 64-bit integers, and whether that is negative, as its absolute value and sign.
struct Difference {
    size: vec2<u32>, // low word, high word
    minus: bool,
}

fn difference(a: vec2<u32>, b: vec2<u32>) -> Difference {
    let d = vec2(a.x - b.x, a.y - b.y - u32(a.x < b.x));
    let minus = (d.y >> 31u) != 0u;
    return Difference(select(d, vec2(0u - d.x, ~d.y + u32(d.x == 0u)), minus), minus);
}

// Bits of a number up to its leading one.
fn bits(n: vec2<u32>) -> i32 {
    return 64 - i32(select(countLeadingZeros(n.y), 32u + countLeadingZeros(n.x), n.y == 0u));
}

// d·2^e.
fn scaled(d: Difference, e: i32) -> Two {
    let count = bits(d.size);
    let shift = u32(64 - count);
    var n = d.size; // its leading one moves to bit 63
    if shift >= 32u { n = vec2(0u, n.x); }
    if (shift & 31u) != 0u {
        n = vec2(n.x << (shift & 31u), (n.y << (shift & 31u)) | (n.x >> (32u - (shift & 31u))));
    }
    let high = f32(n.y >> 8u) * power_of_two(count - 24 + e);
    let low = f32(((n.y & 0xffu) << 16u) | (n.x >> 16u)) * power_of_two(count - 48 + e);
    let sum = ordered_sum(high, low);
    return select(sum, -sum, d.minus);
}

fn dot3(a: array<Two, 3>, b: array<Two, 3>) -> Two {
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]));
}

fn sub3(a: array<Two, 3>, b: array<Two, 3>) -> array<Two, 3> {
    return array<Two, 3>(sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2]));
}

// d dᵀ: xx, xy, xz, yy, yz, zz.
fn outer(d: array<Two, 3>) -> array<Two, 6> {
    return array<Two, 6>(
        mul(d[0], d[0]), mul(d[0], d[1]), mul(d[0], d[2]), mul(d[1], d[1]), mul(d[1], d[2]), mul(d[2], d[2]),
    );
}

// Symmetric, both halves kept; rows of `vectors` are the eigenvectors of `values`, which descend.
struct Eigen {
    values: array<Two, 3>,
    vectors: array<array<Two, 3>, 3>,
}

// An entry this small beside the diagonal's is zero.
const VANISHING = 2.8e-17; // 2^-55

// So is one this small, because devices may flush its error, or its quotient, to zero.
const TINY = 1e-36;

// Cyclic Jacobi, as g2ard_core::linalg::symmetric_eigen.
fn symmetric_eigen(m: array<Two, 6>) -> Eigen {
    var a = array<array<Two, 3>, 3>(
        array<Two, 3>(m[0], m[1], m[2]),
        array<Two, 3>(m[1], m[3], m[4]),
        array<Two, 3>(m[2], m[4], m[5]),
    );
    var v = array<array<Two, 3>, 3>(
        array<Two, 3>(ONE, ZERO, ZERO),
        array<Two, 3>(ZERO, ONE, ZERO),
        array<Two, 3>(ZERO, ZERO, ONE),
    );
    for (var step = 0; step < 48; step++) {
        let turn = step % 3;
        if turn == 0 && a[0][1].x == 0.0 && a[0][2].x == 0.0 && a[1][2].x == 0.0 { break; }
        let p = select(0, 1, turn == 2);
        let q = select(2, 1, turn == 0);
        let r = 3 - p - q;
        let apq = a[p][q];
        a[p][q] = ZERO;
        a[q][p] = ZERO;
        if abs(apq.x) <= max(TINY, VANISHING * max(abs(a[p][p].x), abs(a[q][q].x))) { continue; }
        let theta = div(sub(a[q][q], a[p][p]), 2.0 * apq);
        let by = add(mag(theta), root(add(mul(theta, theta), ONE)));
        let t = div(single(select(1.0, -1.0, theta.x < 0.0)), by);
        let c = div(ONE, root(add(mul(t, t), ONE)));
        let s = mul(t, c);
        let shift = mul(t, apq);
        a[p][p] = sub(a[p][p], shift);
        a[q][q] = add(a[q][q], shift);
        // One loop for the three columns of v and for the row of a that the rotation leaves.
        for (var i = 0; i < 4; i++) {
            var x = a[r][p];
            var y = a[r][q];
            if i < 3 {
                x = v[p][i];
                y = v[q][i];
            }
            let turned_x = sub(mul(c, x), mul(s, y));
            let turned_y = add(mul(s, x), mul(c, y));
            if i < 3 {
                v[p][i] = turned_x;
                v[q][i] = turned_y;
            } else {
                a[r][p] = turned_x;
                a[r][q] = turned_y;
                a[p][r] = turned_x;
                a[q][r] = turned_y;
            }
        }
    }
    let order = descending(array<Two, 3>(a[0][0], a[1][1], a[2][2]));
    var e: Eigen;
    for (var k = 0; k < 3; k++) {
        e.values[k] = a[order[k]][order[k]];
        e.vectors[k] = v[order[k]];
    }
    return e;
}

// The order in which three numbers descend; equal ones keep theirs.
fn descending(values: array<Two, 3>) -> array<i32, 3> {
    var v = values;
    var order = array<i32, 3>(0, 1, 2);
    for (var round = 0; round < 3; round++) {
        let at = round % 2;
        let x = order[at];
        let y = order[at + 1];
        if lt(v[x], v[y]) {
            order[at] = y;
            order[at + 1] = x;
        }
    }
    return order;
}
