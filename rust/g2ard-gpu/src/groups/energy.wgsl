// affine_energy of g2ard_core::linalg. A thread takes one group: it fits colour by an affine function of
// position along the principal axes, then sums the squared residuals of the group's own rows. Rows lie group by
// group; sums run in their order.

struct Member {
    mean: array<F64, 3>,
    color: array<F64, 3>,
}

@group(0) @binding(0) var<uniform> groups: vec4<u32>; // how many
@group(0) @binding(1) var<storage, read> members: array<Member>;
@group(0) @binding(2) var<storage, read> segments: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> energies: array<F64>;

const RANK_FLOOR = F64(0x812dea11u, 0x3d719799u); // 1e-12

struct Fit {
    center: array<F64, 3>,
    color: array<F64, 3>,
    rank: u32,
    axes: array<array<F64, 3>, 3>,
    slopes: array<array<F64, 3>, 3>,
}

// Centred least squares over a group's rows.
fn fit(g: Group) -> Fit {
    var f: Fit;
    let end = g.first + g.count;
    let inverse_count = div(ONE, from_count(g.count));
    // Means about the first row, so that a far-away origin costs no digits.
    let base = members[g.first];
    var point_sum: array<F64, 3>;
    var color_sum: array<F64, 3>;
    for (var i = g.first; i < end; i++) {
        for (var k = 0; k < 3; k++) {
            point_sum[k] = add(point_sum[k], sub(members[i].mean[k], base.mean[k]));
            color_sum[k] = add(color_sum[k], sub(members[i].color[k], base.color[k]));
        }
    }
    for (var k = 0; k < 3; k++) {
        f.center[k] = add(base.mean[k], mul(point_sum[k], inverse_count));
        f.color[k] = add(base.color[k], mul(color_sum[k], inverse_count));
    }
    var scatter: array<F64, 6>;
    for (var i = g.first; i < end; i++) {
        let o = outer(sub3(members[i].mean, f.center));
        for (var k = 0; k < 6; k++) { scatter[k] = add(scatter[k], o[k]); }
    }
    let e = symmetric_eigen(scatter);
    let narrow = mul(RANK_FLOOR, e.values[0]);
    for (var k = 0; k < 3; k++) { f.rank += u32(lt(narrow, e.values[k])); }
    f.axes = e.vectors;
    for (var k = 0u; k < f.rank; k++) {
        var zz = ZERO;
        var zc: array<F64, 3>;
        for (var i = g.first; i < end; i++) {
            let z = dot3(f.axes[k], sub3(members[i].mean, f.center));
            let c = sub3(members[i].color, f.color);
            zz = add(zz, mul(z, z));
            for (var j = 0; j < 3; j++) { zc[j] = add(zc[j], mul(z, c[j])); }
        }
        for (var j = 0; j < 3; j++) { f.slopes[k][j] = div(zc[j], zz); }
    }
    return f;
}

// A row's colour less what the fit predicts there.
fn residual(f: Fit, i: u32) -> array<F64, 3> {
    let d = sub3(members[i].mean, f.center);
    var color = f.color;
    for (var k = 0u; k < f.rank; k++) {
        let z = dot3(f.axes[k], d);
        for (var j = 0; j < 3; j++) { color[j] = add(color[j], mul(z, f.slopes[k][j])); }
    }
    return sub3(members[i].color, color);
}

@compute @workgroup_size(64)
fn energy(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) size: vec3<u32>,
) {
    let at = thread_of(id, size, 64u);
    if at >= groups.x { return; }
    let g = group_of(segments[at]);
    if g.count < 2u || g.own == 0u {
        energies[at] = ZERO;
        return;
    }
    let f = fit(g);
    var sum = ZERO;
    for (var i = g.first; i < g.first + g.own; i++) {
        let r = residual(f, i);
        sum = add(sum, dot3(r, r));
    }
    energies[at] = div(sum, from_count(g.own));
}
