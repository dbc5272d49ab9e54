// IEEE 754 double precision in integers, rounded to nearest even: bit for bit what the CPU computes, on
// every driver. (Pairs of floats would be faster, but WGSL lets compilers reassociate and fuse, and has no
// f64.) A result below 2^-1022 becomes zero; one too large, infinite; NaN never arises in the kernels here.

alias F64 = vec2<u32>; // low word, high word

const ZERO = F64(0u, 0u);
const ONE = F64(0u, 0x3ff00000u);
const TWO = F64(0u, 0x40000000u);

fn neg(a: F64) -> F64 { return F64(a.x, a.y ^ 0x80000000u); }
fn mag(a: F64) -> F64 { return F64(a.x, a.y & 0x7fffffffu); }
fn is_zero(a: F64) -> bool { return (a.x | (a.y & 0x7fffffffu)) == 0u; }

// a < b of words without a sign.
fn below(a: vec2<u32>, b: vec2<u32>) -> bool { return a.y < b.y || (a.y == b.y && a.x < b.x); }

// a < b; −0 and 0 are equal.
fn lt(a: F64, b: F64) -> bool {
    if is_zero(a) && is_zero(b) { return false; }
    let minus_a = (a.y >> 31u) != 0u;
    let minus_b = (b.y >> 31u) != 0u;
    if minus_a != minus_b { return minus_a; }
    return select(below(a, b), below(b, a), minus_a);
}

// The larger by total order: −0 before 0.
fn total_lt(a: F64, b: F64) -> bool {
    let minus_a = (a.y >> 31u) != 0u;
    let minus_b = (b.y >> 31u) != 0u;
    if minus_a != minus_b { return minus_a; }
    return select(below(a, b), below(b, a), minus_a);
}

fn plus64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2(low, a.y + b.y + u32(low < a.x));
}

fn minus64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    return vec2(a.x - b.x, a.y - b.y - u32(a.x < b.x));
}

// Shifts by 0 … 63.
fn left64(a: vec2<u32>, n: u32) -> vec2<u32> {
    if n >= 32u { return vec2(0u, a.x << (n - 32u)); }
    if n == 0u { return a; }
    return vec2(a.x << n, (a.y << n) | (a.x >> (32u - n)));
}

// Shifts to the right; what falls off leaves its trace in the last bit.
fn right64_sticky(a: vec2<u32>, n: u32) -> vec2<u32> {
    if n == 0u { return a; }
    if n >= 64u { return vec2(u32((a.x | a.y) != 0u), 0u); }
    if n >= 32u {
        let m = n - 32u;
        let lost = a.x | (a.y & ((1u << m) - 1u));
        return vec2((a.y >> m) | u32(lost != 0u), 0u);
    }
    let lost = a.x & ((1u << n) - 1u);
    return vec2((a.x >> n) | (a.y << (32u - n)) | u32(lost != 0u), a.y >> n);
}

// All 64 bits of a product.
fn wide(a: u32, b: u32) -> vec2<u32> {
    let al = a & 0xffffu; let ah = a >> 16u;
    let bl = b & 0xffffu; let bh = b >> 16u;
    let low = al * bl;
    let mid = ah * bl + (low >> 16u); // at most 0xffff² + 0xffff: no overflow
    let mix = al * bh + (mid & 0xffffu);
    return vec2((mix << 16u) | (low & 0xffffu), ah * bh + (mid >> 16u) + (mix >> 16u));
}

fn exponent(a: F64) -> i32 { return i32((a.y >> 20u) & 0x7ffu); }
fn mantissa(a: F64) -> vec2<u32> { return vec2(a.x, (a.y & 0xfffffu) | 0x100000u); }

// A mantissa whose first bit is bit 62, to be read as one with exponent `e`; its last 10 bits are rounded off.
fn pack(sign: u32, e: i32, m: vec2<u32>) -> F64 {
    if e <= 0 { return F64(0u, sign); }
    let odd = (m.x >> 10u) & 1u;
    let r = plus64(m, vec2(0x1ffu + odd, 0u));
    let kept = vec2((r.x >> 10u) | (r.y << 22u), r.y >> 10u);
    // The leading bit of the mantissa adds one to the exponent, as does a carry.
    let high = (u32(e - 1) << 20u) + kept.y;
    if high >= 0x7ff00000u { return F64(0u, sign | 0x7ff00000u); }
    return F64(kept.x, sign | high);
}

fn add(p: F64, q: F64) -> F64 {
    let swap = below(mag(p), mag(q));
    let a = select(p, q, swap);
    let b = select(q, p, swap);
    if exponent(b) == 0 {
        if exponent(a) == 0 { return F64(0u, a.y & b.y & 0x80000000u); }
        return a;
    }
    var e = exponent(a);
    let big = left64(mantissa(a), 10u);
    let small = right64_sticky(left64(mantissa(b), 10u), u32(e - exponent(b)));
    let sign = a.y & 0x80000000u;
    if ((a.y ^ b.y) >> 31u) == 0u {
        var sum = plus64(big, small);
        if (sum.y >> 31u) != 0u {
            sum = right64_sticky(sum, 1u);
            e += 1;
        }
        return pack(sign, e, sum);
    }
    let rest = minus64(big, small);
    if (rest.x | rest.y) == 0u { return ZERO; }
    let lead = select(countLeadingZeros(rest.y), 32u + countLeadingZeros(rest.x), rest.y == 0u);
    return pack(sign, e - i32(lead) + 1, left64(rest, lead - 1u));
}

fn sub(a: F64, b: F64) -> F64 { return add(a, neg(b)); }

fn mul(a: F64, b: F64) -> F64 {
    let sign = (a.y ^ b.y) & 0x80000000u;
    if exponent(a) == 0 || exponent(b) == 0 { return F64(0u, sign); }
    let m = left64(mantissa(a), 10u);
    let n = left64(mantissa(b), 10u);
    let low = wide(m.x, n.x);
    let middle = plus64(plus64(wide(m.x, n.y), wide(m.y, n.x)), vec2(low.y, 0u)); // each below 2^63
    var high = plus64(wide(m.y, n.y), vec2(middle.y, 0u));
    high.x |= u32((low.x | middle.x) != 0u);
    let top = high.y >> 29u; // 1 where the product is 2 or more, of mantissas from 1
    return pack(sign, exponent(a) + exponent(b) - 1023 + i32(top), left64(high, 2u - top));
}

// A word times 64 bits, the lower 64 of it.
fn times64(a: vec2<u32>, n: u32) -> vec2<u32> {
    let low = wide(a.x, n);
    return vec2(low.x, low.y + a.y * n);
}

fn rough(a: vec2<u32>) -> f32 { return f32(a.y) * 4294967296.0 + f32(a.x); }

fn negative(a: vec2<u32>) -> bool { return (a.y >> 31u) != 0u; }

// Eleven bits at a time: f32 guesses them, at most one off, and what is left over puts that right.
fn div(a: F64, b: F64) -> F64 {
    let sign = (a.y ^ b.y) & 0x80000000u;
    if exponent(a) == 0 { return F64(0u, sign); }
    if exponent(b) == 0 { return F64(0u, sign | 0x7ff00000u); }
    var rest = mantissa(a);
    let by = mantissa(b);
    var e = exponent(a) - exponent(b) + 1023;
    if below(rest, by) {
        rest = left64(rest, 1u);
        e -= 1;
    }
    rest = minus64(rest, by);
    var quotient = vec2(1u, 0u);
    let scale = 2048.0 / rough(by);
    for (var i = 0; i < 5; i++) {
        var digit = u32(rough(rest) * scale);
        rest = minus64(left64(rest, 11u), times64(by, digit));
        if negative(rest) {
            digit -= 1u;
            rest = plus64(rest, by);
        } else if !below(rest, by) {
            digit += 1u;
            rest = minus64(rest, by);
        }
        quotient = plus64(left64(quotient, 11u), vec2(digit, 0u));
    }
    quotient = left64(quotient, 7u); // 56 bits so far
    quotient.x |= u32((rest.x | rest.y) != 0u);
    return pack(sign, e, quotient);
}

// Of what is not negative. Eleven bits at a time, as `div`; what is left over fits into 64 bits at every step,
// though what it is the difference of may not.
fn root(a: F64) -> F64 {
    if exponent(a) == 0 { return a; }
    let even = exponent(a) - 1023;
    let odd = u32(even & 1);
    var bits = left64(mantissa(a), 10u + odd); // the radicand's first two bits are at the top
    var rest = vec2(0u, 0u);
    var value = vec2(0u, 0u);
    for (var i = 0; i < 5; i++) {
        let next = bits.y >> 10u;
        bits = left64(bits, 22u);
        let radicand = rough(rest) * 4194304.0 + f32(next);
        var digit = u32(select(radicand / (4096.0 * rough(value)), sqrt(radicand), i == 0));
        let twice = left64(value, 12u);
        rest = plus64(left64(rest, 22u), vec2(next, 0u));
        rest = minus64(rest, times64(plus64(twice, vec2(digit, 0u)), digit));
        for (var k = 0; k < 2; k++) {
            if negative(rest) {
                rest = plus64(rest, plus64(twice, vec2(2u * digit - 1u, 0u)));
                digit -= 1u;
            }
        }
        let more = plus64(twice, vec2(2u * digit + 1u, 0u));
        if !negative(rest) && !below(rest, more) {
            rest = minus64(rest, more);
            digit += 1u;
        }
        value = plus64(left64(value, 11u), vec2(digit, 0u));
    }
    value = left64(value, 8u); // 55 bits so far
    value.x |= u32((rest.x | rest.y) != 0u);
    return pack(0u, ((even - i32(odd)) / 2) + 1023, value);
}

// The same number, from the bits of a finite f32.
fn widen(bits: u32) -> F64 {
    let sign = bits & 0x80000000u;
    let e = (bits >> 23u) & 0xffu;
    let m = bits & 0x7fffffu;
    if e != 0u { return F64(m << 29u, sign | ((e + 896u) << 20u) | (m >> 3u)); }
    if m == 0u { return F64(0u, sign); }
    let lead = countLeadingZeros(m); // 9 and more: below the normal f32
    let n = left64(vec2(m, 0u), lead + 21u); // the first bit at bit 52
    return F64(n.x, sign | ((905u - lead) << 20u) | (n.y & 0xfffffu));
}

// The bits of the nearest f32.
fn narrow(a: F64) -> u32 {
    let sign = a.y & 0x80000000u;
    let e = exponent(a) - 896;
    if e <= 0 { return sign; }
    if e >= 255 { return sign | 0x7f800000u; }
    let m = ((a.y << 3u) & 0x7fffffu) | (a.x >> 29u);
    let rest = a.x & 0x1fffffffu;
    let up = u32(rest > 0x10000000u || (rest == 0x10000000u && (m & 1u) == 1u));
    return sign | ((u32(e) << 23u) + m + up);
}

fn larger(a: F64, b: F64) -> F64 { return select(a, b, lt(a, b)); }

fn dot3(a: array<F64, 3>, b: array<F64, 3>) -> F64 {
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]));
}

fn sub3(a: array<F64, 3>, b: array<F64, 3>) -> array<F64, 3> {
    return array<F64, 3>(sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2]));
}

// d dᵀ: xx, xy, xz, yy, yz, zz.
fn outer(d: array<F64, 3>) -> array<F64, 6> {
    var o: array<F64, 6>;
    for (var n = 0; n < 6; n++) {
        let i = select(select(0, 1, n > 2), 2, n > 4);
        let j = select(select(n, n - 2, n > 2), 2, n > 4);
        o[n] = mul(d[i], d[j]);
    }
    return o;
}

fn from_count(n: u32) -> F64 {
    if n == 0u { return ZERO; }
    let lead = countLeadingZeros(n);
    let m = left64(vec2(n, 0u), 21u + lead); // the first bit at bit 52
    return F64(m.x, ((1054u - lead) << 20u) | (m.y & 0xfffffu));
}
