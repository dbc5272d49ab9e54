// affine_energy of g2ard_core::linalg. A thread takes one group: it fits colour by an affine function of
// position along the principal axes, then sums the squared residuals of the group's own rows. Rows lie group by
// group; sums run in their order. Positions are relative to the first row and at most about 1.

struct Member {
    color: array<f32, 3>, // SH of band 0
    mean: array<u32, 6>, // 64-bit integers, low words first
}

@group(0) @binding(3) var<storage, read_write> energies: array<Two>;

const RANK_FLOOR = Two(1e-12, 0.0);
const SH_C0 = Two(0.28209481, -1.4658846e-8);

struct Place {
    base: u32, // the first row
    e: i32, // positions are times 2^-e
}

struct Fit {
    center: array<Two, 3>,
    color: array<Two, 3>,
    rank: u32,
    axes: array<array<Two, 3>, 3>,
    slopes: array<array<Two, 3>, 3>,
}

// 0.5 + SH_C0·sh, cut to [0, 1].
fn color_of(i: u32) -> array<Two, 3> {
    var color: array<Two, 3>;
    for (var k = 0; k < 3; k++) {
        let c = add(single(0.5), mul(SH_C0, single(members[i].color[k])));
        color[k] = select(larger(c, ZERO), ONE, lt(ONE, c));
    }
    return color;
}

// Centred least squares over a group's rows.
fn fit(g: Group, at: Place) -> Fit {
    var f: Fit;
    let end = g.first + g.count;
    let inverse_count = div(ONE, single(f32(g.count)));
    // Colours about the first row's, as positions are.
    let base = color_of(g.first);
    var point_sum: array<Two, 3>;
    var color_sum: array<Two, 3>;
    for (var i = g.first; i < end; i++) {
        let p = offset(i, at.base, at.e);
        let c = sub3(color_of(i), base);
        for (var k = 0; k < 3; k++) {
            point_sum[k] = add(point_sum[k], p[k]);
            color_sum[k] = add(color_sum[k], c[k]);
        }
    }
    for (var k = 0; k < 3; k++) {
        f.center[k] = mul(point_sum[k], inverse_count);
        f.color[k] = add(base[k], mul(color_sum[k], inverse_count));
    }
    var scatter: array<Two, 6>;
    for (var i = g.first; i < end; i++) {
        let o = outer(sub3(offset(i, at.base, at.e), f.center));
        for (var k = 0; k < 6; k++) { scatter[k] = add(scatter[k], o[k]); }
    }
    let e = symmetric_eigen(scatter);
    let narrow = mul(RANK_FLOOR, e.values[0]);
    for (var k = 0; k < 3; k++) { f.rank += u32(lt(narrow, e.values[k])); }
    f.axes = e.vectors;
    for (var k = 0u; k < f.rank; k++) {
        var zz = ZERO;
        var zc: array<Two, 3>;
        for (var i = g.first; i < end; i++) {
            let z = dot3(f.axes[k], sub3(offset(i, at.base, at.e), f.center));
            let c = sub3(color_of(i), f.color);
            zz = add(zz, mul(z, z));
            for (var j = 0; j < 3; j++) { zc[j] = add(zc[j], mul(z, c[j])); }
        }
        for (var j = 0; j < 3; j++) { f.slopes[k][j] = div(zc[j], zz); }
    }
    return f;
}

// A row's colour less what the fit predicts there.
fn residual(f: Fit, i: u32, at: Place) -> array<Two, 3> {
    let d = sub3(offset(i, at.base, at.e), f.center);
    var color = f.color;
    for (var k = 0u; k < f.rank; k++) {
        let z = dot3(f.axes[k], d);
        for (var j = 0; j < 3; j++) { color[j] = add(color[j], mul(z, f.slopes[k][j])); }
    }
    return sub3(color_of(i), color);
}

@compute @workgroup_size(64)
fn energy(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) size: vec3<u32>,
) {
    hidden = groups.w;
    let n = thread_of(id, size, 64u);
    if n >= groups.x { return; }
    let g = group_of(segments[n]);
    if g.count < 2u || g.own == 0u {
        energies[n] = ZERO;
        return;
    }
    var at = Place(g.first, 0);
    for (var i = g.first + 1u; i < g.first + g.count; i++) { at.e = max(at.e, extent(i, g.first)); }
    let f = fit(g, at);
    var sum = ZERO;
    for (var i = g.first; i < g.first + g.own; i++) {
        let r = residual(f, i, at);
        sum = add(sum, dot3(r, r));
    }
    energies[n] = div(sum, single(f32(g.own)));
}
