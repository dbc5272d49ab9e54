// Moments of a group (pool and Gaussian::from_moments of g2ard_core::simplify) and the share of it that the
// merged Gaussian covers (guards). A thread takes one group; rows lie group by group, sums run in their order.
// Lengths are times 2^-e, so that the group's largest is at most about 1.

struct Member {
    mean: array<u32, 6>, // 64-bit integers, low words first
    mass: f32, // times 2^power
    power: i32,
    scales: array<f32, 3>,
    quat: array<f32, 4>, // wxyz
}

struct Merged {
    mean: array<Two, 3>, // less that of the first row
    axes: array<array<Two, 3>, 3>, // in order of descending scale
    scales: array<Two, 3>,
    covered: f32,
    e: i32,
}

@group(0) @binding(3) var<storage, read_write> merged: array<Merged>;
@group(0) @binding(4) var<storage, read> disc: array<vec2<f32>, 16>;

const VARIANCE_FLOOR = Two(1e-14, 0.0);

// 1 − 2(a·a + b·b).
fn diagonal(a: Two, b: Two) -> Two { return sub(ONE, 2.0 * add(mul(a, a), mul(b, b))); }

// Rows of the rotation of a quaternion of any length.
fn rotation(given: array<f32, 4>) -> array<array<Two, 3>, 3> {
    var q: array<Two, 4>;
    var largest = ZERO;
    for (var k = 0; k < 4; k++) {
        q[k] = single(given[k]);
        largest = larger(largest, mag(q[k]));
    }
    var r = array<array<Two, 3>, 3>(
        array<Two, 3>(ONE, ZERO, ZERO),
        array<Two, 3>(ZERO, ONE, ZERO),
        array<Two, 3>(ZERO, ZERO, ONE),
    );
    if largest.x == 0.0 { return r; }
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
        r[j][i] = 2.0 * add(across, along);
        r[i][j] = 2.0 * sub(across, along);
    }
    return r;
}

fn covariance(r: array<array<Two, 3>, 3>, scales: array<Two, 3>) -> array<Two, 6> {
    var v: array<Two, 3>;
    for (var k = 0; k < 3; k++) { v[k] = mul(scales[k], scales[k]); }
    var c: array<Two, 6>;
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

// Of 16 points that divide a member's footprint evenly, those within the merged footprint: the footprint's centre and
// half axes along each of the merged ones, in units of theirs.
fn hits(u: vec3<f32>, v: vec3<f32>) -> f32 {
    var count = 0.0;
    for (var s = 0; s < 16; s++) {
        let at = vec3(1.0, disc[s]);
        let x = dot(u, at);
        let y = dot(v, at);
        count += select(0.0, 1.0, x * x + y * y <= 1.0);
    }
    return count;
}

// Σn·n, not below 0.
fn along(c: array<Two, 6>, n: array<Two, 3>) -> Two {
    let rows = array<Two, 3>(
        dot3(array<Two, 3>(c[0], c[1], c[2]), n),
        dot3(array<Two, 3>(c[1], c[3], c[4]), n),
        dot3(array<Two, 3>(c[2], c[4], c[5]), n),
    );
    return larger(dot3(n, rows), ZERO);
}

// Shadow::of: (l₁₁, l₂₁, l₂₂) of the covariance that a Gaussian has in the plane of two axes. The area l₁₁·l₂₂ is that of
// a cross product, whose parts no needle makes cancel.
fn shadow(r: array<array<Two, 3>, 3>, scales: array<Two, 3>, x: vec3<f32>, y: vec3<f32>) -> vec3<f32> {
    var p: vec3<f32>;
    var q: vec3<f32>;
    for (var k = 0; k < 3; k++) {
        let axis = vec3(r[0][k].x, r[1][k].x, r[2][k].x);
        p[k] = scales[k].x * dot(x, axis);
        q[k] = scales[k].x * dot(y, axis);
    }
    let first = length(p);
    if first == 0.0 { return vec3(0.0, 0.0, length(q)); }
    return vec3(first, dot(p, q) / first, length(cross(p, q)) / first);
}

fn rounded(v: array<Two, 3>) -> vec3<f32> { return vec3(v[0].x, v[1].x, v[2].x); }

// The power of two above a length.
fn power_above(x: f32) -> i32 { return i32((bitcast<u32>(x) >> 23u) & 255u) - 126; }

@compute @workgroup_size(64)
fn merge(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) size: vec3<u32>,
) {
    hidden = groups.w;
    let at = thread_of(id, size, 64u);
    if at >= groups.x { return; }
    let g = group_of(segments[at]);
    let end = g.first + g.count;
    let support = bitcast<f32>(groups.y);
    let unit = bitcast<i32>(groups.z);
    var m: Merged;
    m.e = -126;
    var power = -0x8000;
    for (var i = g.first; i < end; i++) {
        let far = extent(i, g.first);
        if far > 0 { m.e = max(m.e, far + unit); }
        for (var k = 0; k < 3; k++) { m.e = max(m.e, power_above(members[i].scales[k])); }
        power = max(power, members[i].power);
    }
    m.e = min(m.e, 126);
    var total = ZERO;
    for (var i = g.first; i < end; i++) { total = add(total, weight(i, power)); }
    let massless = total.x == 0.0; // averaged evenly
    if massless { total = single(f32(g.count)); }
    for (var i = g.first; i < end; i++) {
        let w = select(weight(i, power), ONE, massless);
        let d = offset(i, g.first, m.e - unit);
        for (var k = 0; k < 3; k++) { m.mean[k] = add(m.mean[k], mul(w, d[k])); }
    }
    for (var k = 0; k < 3; k++) { m.mean[k] = div(m.mean[k], total); }
    var cov: array<Two, 6>;
    var covered = 0.0;
    var area_sum = ZERO;
    var within: array<Two, 6>;
    var reach = ZERO;
    // First over the members' moments, then over their footprints: both need their rotations, and compilers
    // inline every call.
    for (var phase = 0; phase < 2; phase++) {
        for (var i = g.first; i < end; i++) {
            let r = rotation(members[i].quat);
            var scales: array<Two, 3>;
            for (var k = 0; k < 3; k++) { scales[k] = single(members[i].scales[k] * power_of_two(-m.e)); }
            let away = sub3(offset(i, g.first, m.e - unit), m.mean);
            if phase == 0 {
                let c = covariance(r, scales);
                let o = outer(away);
                let w = select(weight(i, power), ONE, massless);
                let axes = descending(scales);
                let area = mul(scales[axes[0]], scales[axes[1]]);
                area_sum = add(area_sum, area);
                for (var k = 0; k < 6; k++) {
                    cov[k] = add(cov[k], mul(w, add(c[k], o[k])));
                    within[k] = add(within[k], mul(area, c[k]));
                }
                continue;
            }
            if lt(reach, mag(dot3(m.axes[2], away))) { continue; }
            let l = shadow(r, scales, rounded(m.axes[0]), rounded(m.axes[1]));
            let x = div(dot3(m.axes[0], away), support * m.scales[0]).x;
            let y = div(dot3(m.axes[1], away), support * m.scales[1]).x;
            let u = vec3(x, l.x / m.scales[0].x, 0.0);
            let v = vec3(y, l.yz / m.scales[1].x);
            covered += l.x * l.z * hits(u, v) / 16.0;
        }
        if phase == 0 {
            for (var k = 0; k < 6; k++) { cov[k] = div(cov[k], total); }
            let e = symmetric_eigen(cov);
            let least = mul(VARIANCE_FLOOR, e.values[0]);
            for (var k = 0; k < 3; k++) { m.scales[k] = root(larger(e.values[k], least)); }
            m.axes = e.vectors;
            if area_sum.x == 0.0 { break; }
            reach = mul(single(support), root(div(along(within, m.axes[2]), area_sum)));
        }
    }
    m.covered = 1.0;
    if area_sum.x > 0.0 { m.covered = covered / area_sum.x; }
    merged[at] = m;
}

// A member's weight beside the heaviest.
fn weight(i: u32, power: i32) -> Two {
    return single(members[i].mass * power_of_two(members[i].power - power));
}
