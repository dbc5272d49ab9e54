// Moments of a group (pool and Gaussian::from_moments of g2ard_core::simplify) and the share of it that the
// merged Gaussian covers (guards). A thread takes one group; rows lie group by group, sums run in their order.

struct Member {
    mean: array<F64, 3>,
    weight: F64,
    quat: array<u32, 4>, // wxyz, bits of f32
    scales: array<u32, 3>,
    spare: u32,
}

struct Merged {
    mean: array<F64, 3>,
    axes: array<array<F64, 3>, 3>, // in order of descending scale
    scales: array<F64, 3>,
    covered: F64,
}

@group(0) @binding(0) var<uniform> groups: vec4<u32>; // how many; then the support, a double
@group(0) @binding(1) var<storage, read> members: array<Member>;
@group(0) @binding(2) var<storage, read> segments: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> merged: array<Merged>;
@group(0) @binding(4) var<storage, read> disc: array<array<F64, 2>, 16>;

const VARIANCE_FLOOR = F64(0x86a12b9bu, 0x3d06849bu); // 1e-14
const LEAST_VARIANCE = F64(0u, 0x30300000u); // the least normal f32, squared
const SIXTEENTH = F64(0u, 0x3fb00000u);

// 1 − 2(a·a + b·b).
fn diagonal(a: F64, b: F64) -> F64 { return sub(ONE, mul(TWO, add(mul(a, a), mul(b, b)))); }

// Rows of the rotation of a quaternion of any length.
fn rotation(bits: array<u32, 4>) -> array<array<F64, 3>, 3> {
    var q: array<F64, 4>;
    var largest = ZERO;
    for (var k = 0; k < 4; k++) {
        q[k] = widen(bits[k]);
        largest = larger(largest, mag(q[k]));
    }
    var r = array<array<F64, 3>, 3>(
        array<F64, 3>(ONE, ZERO, ZERO),
        array<F64, 3>(ZERO, ONE, ZERO),
        array<F64, 3>(ZERO, ZERO, ONE),
    );
    if is_zero(largest) { return r; }
    var by = largest;
    for (var round = 0; round < 2; round++) {
        var squares = ZERO;
        for (var k = 0; k < 4; k++) {
            q[k] = div(q[k], by);
            squares = add(squares, mul(q[k], q[k]));
        }
        by = root(squares);
    }
    for (var i = 0; i < 3; i++) {
        let j = (i + 1) % 3;
        let k = (i + 2) % 3;
        r[i][i] = diagonal(q[1 + min(j, k)], q[1 + max(j, k)]);
        // r[1][0], r[2][1], r[0][2] add w·axis; their mirror images subtract it.
        let across = mul(q[1 + min(i, j)], q[1 + max(i, j)]);
        let along = mul(q[0], q[1 + k]);
        r[j][i] = mul(TWO, add(across, along));
        r[i][j] = mul(TWO, sub(across, along));
    }
    return r;
}

fn covariance(r: array<array<F64, 3>, 3>, scales: array<F64, 3>) -> array<F64, 6> {
    var v: array<F64, 3>;
    for (var k = 0; k < 3; k++) { v[k] = mul(scales[k], scales[k]); }
    var c: array<F64, 6>;
    for (var n = 0; n < 6; n++) {
        let i = select(select(0, 1, n > 2), 2, n > 4);
        let j = select(select(n, n - 2, n > 2), 2, n > 4);
        var sum = ZERO;
        for (var k = 0; k < 3; k++) {
            let term = mul(mul(r[i][k], v[k]), r[j][k]);
            if k == 0 { sum = term; } else { sum = add(sum, term); }
        }
        c[n] = sum;
    }
    return c;
}

// Axes in order of descending scale; all scales are positive or zero.
fn by_scale(scales: array<F64, 3>) -> array<i32, 3> {
    var order = array<i32, 3>(0, 1, 2);
    for (var round = 0; round < 3; round++) {
        let at = round % 2;
        let x = order[at];
        if total_lt(scales[x], scales[order[at + 1]]) {
            order[at] = order[at + 1];
            order[at + 1] = x;
        }
    }
    return order;
}

// How much more than 1 u² + v² is, in f32: −1, 1, or 0 where only doubles can tell.
fn roughly(u: vec3<f32>, v: vec3<f32>, at: vec3<f32>) -> i32 {
    let x = dot(u, at);
    let y = dot(v, at);
    let size = dot(abs(u), vec3(1.0)) + dot(abs(v), vec3(1.0));
    let over = x * x + y * y - 1.0;
    let doubt = 1e-5 * (1.0 + size * size);
    if over > doubt { return 1; }
    if over < -doubt { return -1; }
    return 0;
}

fn single(a: F64) -> f32 { return bitcast<f32>(narrow(a)); }

fn along_disc(w: array<F64, 3>, x: F64, y: F64) -> F64 {
    return add(add(w[0], mul(x, w[1])), mul(y, w[2]));
}

// Of 16 points that divide a member's footprint evenly, those within the merged footprint: `w` are the
// footprint's centre and half axes along the merged ones, in units of theirs.
fn hits(w: array<array<F64, 3>, 2>) -> u32 {
    let u = vec3(single(w[0][0]), single(w[0][1]), single(w[0][2]));
    let v = vec3(single(w[1][0]), single(w[1][1]), single(w[1][2]));
    var count = 0u;
    for (var s = 0; s < 16; s++) {
        let x = disc[s][0];
        let y = disc[s][1];
        var over = roughly(u, v, vec3(1.0, single(x), single(y)));
        if over == 0 {
            var squares = ZERO;
            for (var t = 0; t < 2; t++) {
                let a = along_disc(w[t], x, y);
                squares = add(squares, mul(a, a));
            }
            over = select(-1, 1, lt(ONE, squares));
        }
        count += u32(over < 0);
    }
    return count;
}

// Σn·n, not below 0.
fn along(c: array<F64, 6>, n: array<F64, 3>) -> F64 {
    let rows = array<F64, 3>(
        dot3(array<F64, 3>(c[0], c[1], c[2]), n),
        dot3(array<F64, 3>(c[1], c[3], c[4]), n),
        dot3(array<F64, 3>(c[2], c[4], c[5]), n),
    );
    return larger(dot3(n, rows), ZERO);
}

// Shadow::of: L of the covariance that a Gaussian has in the plane of the first two axes.
fn shadow(
    r: array<array<F64, 3>, 3>,
    scales: array<F64, 3>,
    axes: array<array<F64, 3>, 3>,
) -> array<array<F64, 2>, 2> {
    var p: array<F64, 3>;
    var q: array<F64, 3>;
    for (var k = 0; k < 3; k++) {
        let axis = array<F64, 3>(r[0][k], r[1][k], r[2][k]);
        p[k] = mul(scales[k], dot3(axes[0], axis));
        q[k] = mul(scales[k], dot3(axes[1], axis));
    }
    let first = root(dot3(p, p));
    var second = ZERO;
    var lean = ZERO;
    if !is_zero(first) {
        second = div(dot3(p, q), first);
        lean = div(second, first);
    }
    for (var k = 0; k < 3; k++) { q[k] = sub(q[k], mul(p[k], lean)); }
    return array<array<F64, 2>, 2>(
        array<F64, 2>(first, ZERO),
        array<F64, 2>(second, root(dot3(q, q))),
    );
}

@compute @workgroup_size(64)
fn merge(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) size: vec3<u32>,
) {
    let at = thread_of(id, size, 64u);
    if at >= groups.x { return; }
    let g = group_of(segments[at]);
    let end = g.first + g.count;
    var m: Merged;
    let base = members[g.first].mean;
    var total = ZERO;
    for (var i = g.first; i < end; i++) { total = add(total, members[i].weight); }
    let massless = is_zero(total); // averaged evenly
    if massless { total = from_count(g.count); }
    var shift: array<F64, 3>;
    for (var i = g.first; i < end; i++) {
        let w = select(members[i].weight, ONE, massless);
        let d = sub3(members[i].mean, base);
        for (var k = 0; k < 3; k++) { shift[k] = add(shift[k], mul(w, d[k])); }
    }
    for (var k = 0; k < 3; k++) { m.mean[k] = add(base[k], div(shift[k], total)); }
    var cov: array<F64, 6>;
    var covered = ZERO;
    var area_sum = ZERO;
    var within: array<F64, 6>;
    var reach = ZERO;
    let support = F64(groups.y, groups.z);
    // First over the members' moments, then over their footprints: both need their rotations, and compilers
    // inline every call.
    for (var phase = 0; phase < 2; phase++) {
        for (var i = g.first; i < end; i++) {
            let r = rotation(members[i].quat);
            var scales: array<F64, 3>;
            for (var k = 0; k < 3; k++) { scales[k] = widen(members[i].scales[k]); }
            let offset = sub3(members[i].mean, m.mean);
            if phase == 0 {
                let c = covariance(r, scales);
                let o = outer(offset);
                let w = select(members[i].weight, ONE, massless);
                let axes = by_scale(scales);
                let area = mul(scales[axes[0]], scales[axes[1]]);
                area_sum = add(area_sum, area);
                for (var k = 0; k < 6; k++) {
                    cov[k] = add(cov[k], mul(w, add(c[k], o[k])));
                    within[k] = add(within[k], mul(area, c[k]));
                }
                continue;
            }
            if lt(reach, mag(dot3(m.axes[2], offset))) { continue; }
            let l = shadow(r, scales, m.axes);
            var w: array<array<F64, 3>, 2>;
            for (var t = 0; t < 2; t++) {
                w[t][0] = div(dot3(m.axes[t], offset), mul(support, m.scales[t]));
                for (var k = 0; k < 2; k++) { w[t][1 + k] = div(l[t][k], m.scales[t]); }
            }
            let area = mul(l[0][0], l[1][1]);
            covered = add(covered, mul(mul(area, from_count(hits(w))), SIXTEENTH));
        }
        if phase == 0 {
            for (var k = 0; k < 6; k++) { cov[k] = div(cov[k], total); }
            let e = symmetric_eigen(cov);
            let floor = larger(mul(VARIANCE_FLOOR, e.values[0]), LEAST_VARIANCE);
            for (var k = 0; k < 3; k++) { m.scales[k] = root(larger(e.values[k], floor)); }
            m.axes = e.vectors;
            if is_zero(area_sum) { break; }
            reach = mul(support, root(div(along(within, m.axes[2]), area_sum)));
        }
    }
    m.covered = ONE;
    if !is_zero(area_sum) { m.covered = div(covered, area_sum); }
    merged[at] = m;
}
