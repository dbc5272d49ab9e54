// A thread sums a Gaussian's pairs in their order, goes back through the projection (g2ard_core::raster::project::unproject)
// and the regularisers (g2ard_core::train::anchors), and takes an Adam task.

struct Row {
    unit: f32, // factor of the mean's rate
    steps: u32,
    frozen: u32,
}

@group(0) @binding(1) var<storage, read_write> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> moments: array<vec2<f32>>; // Adam's two of each value
@group(0) @binding(3) var<storage, read_write> rows: array<Row>;
@group(0) @binding(4) var<storage, read> splats: array<Splat>;
@group(0) @binding(5) var<storage, read> sums: array<array<f32, 9>>;
@group(0) @binding(6) var<storage, read> anchors: array<f32>; // one value after the other: mean, frame, 1/r∥, 1/r⊥
@group(0) @binding(7) var<storage, read> biases: array<f32>; // 1/√(1 − β₂ᵗ) of each count of steps t
@group(0) @binding(8) var<storage, read_write> state: array<atomic<u32>>;

const ANCHOR_FRAME = 3u;
const ANCHOR_PARALLEL = 12u;
const ANCHOR_PERP = 13u;
const GRADIENT_MAX = 1e18;

struct Gradient {
    mean: vec3<f32>,
    quat: vec4<f32>,
    log_scale: vec3<f32>,
    logit: f32,
    rgb: vec3<f32>,
}

// dL/dq of R(q/|q|), from the columns of dL/dR.
fn quaternion_gradient(q: vec4<f32>, rq: f32, g: mat3x3<f32>) -> vec4<f32> {
    let sym = vec3(g[1].x + g[0].y, g[2].x + g[0].z, g[2].y + g[1].z); // xy, xz, yz
    let anti = vec3(g[1].z - g[2].y, g[2].x - g[0].z, g[0].y - g[1].x);
    let v = q.yzw;
    let d = 2.0 * vec4(
        dot(v, anti),
        q.x * anti.x + v.y * sym.x + v.z * sym.y - 2.0 * v.x * (g[1].y + g[2].z),
        q.x * anti.y + v.x * sym.x + v.z * sym.z - 2.0 * v.y * (g[0].x + g[2].z),
        q.x * anti.z + v.x * sym.y + v.y * sym.z - 2.0 * v.z * (g[0].x + g[1].y),
    );
    return (d - q * dot(q, d)) * rq;
}

// Σ weights[k]·∇basis[k] at d, as if the harmonics were polynomials over all of space.
fn basis_gradient(d: vec3<f32>, weights: ptr<function, array<f32, 16>>) -> vec3<f32> {
    let w = *weights;
    let x = d.x;
    let y = d.y;
    let z = d.z;
    var g = C1 * vec3(-w[3], -w[1], w[2]);
    if task.coeffs > 4u {
        let a = C2.x;
        let b = 2.0 * C2.y;
        let c = 2.0 * C2.z;
        g.x += a * (y * w[4] - z * w[7]) + x * (c * w[8] - b * w[6]);
        g.y += a * (x * w[4] - z * w[5]) - y * (b * w[6] + c * w[8]);
        g.z += 2.0 * b * z * w[6] - a * (y * w[5] + x * w[7]);
    }
    if task.coeffs > 9u {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        let a = C3.x;
        let b = C3.y;
        let c = C3.z;
        let e = C3.w;
        g.x += b * (y * z * w[10] + x * z * w[14]) + 2.0 * c * x * y * w[11] - 6.0 * a * x * y * w[9]
            - 6.0 * e * x * z * w[12] - c * (4.0 * zz - 3.0 * xx - yy) * w[13] - 3.0 * a * (xx - yy) * w[15];
        g.y += b * (x * z * w[10] - y * z * w[14]) + 2.0 * c * x * y * w[13] + 6.0 * a * x * y * w[15]
            - 6.0 * e * y * z * w[12] - c * (4.0 * zz - xx - 3.0 * yy) * w[11] - 3.0 * a * (xx - yy) * w[9];
        g.z += b * x * y * w[10] - 8.0 * c * z * (y * w[11] + x * w[13])
            + e * (6.0 * zz - 3.0 * (xx + yy)) * w[12] + 0.5 * b * (xx - yy) * w[14];
    }
    return g;
}

// From a pair's nine sums to the parameters' gradient; `p` is the Gaussian's projection.
fn unproject(p: Projected, sum: array<f32, 9>) -> Gradient {
    var g: Gradient;
    // In whitened coordinates y = U·d nothing cancels: dL/dmean = Uᵀ Σhy, dL/dΣ₂ = ½ Uᵀ (Σ h y yᵀ) U.
    let rk = 1.0 / HALF_LOG2_E;
    let on_screen = rk * vec2(p.a * sum[1], p.b * sum[1] + p.c * sum[2]);
    let half = 0.5 * rk * rk;
    let uu = sum[3] * half;
    let uv = sum[4] * half;
    let vv = sum[5] * half;
    let left = p.b * uu + p.c * uv;
    let gxx = p.a * p.a * uu;
    let gxy = p.a * left;
    let gyy = p.b * left + p.c * (p.b * uv + p.c * vv);
    var dm = array(2.0 * (gxx * p.m[0] + gxy * p.m[1]), 2.0 * (gxy * p.m[0] + gyy * p.m[1]));
    if task.antialiased != 0u {
        // The opacity's factor √(det0 / det): det = det0 + 0.3·tr + 0.09, det0 = |minors|².
        let n = p.minors * sum[0] * (1.0 / max(p.det0, 1.17549435e-38) - 1.0 / p.det);
        let on_trace = sum[0] * DILATION / p.det;
        dm[0] += cross(p.m[1], n) - on_trace * p.m[0];
        dm[1] += cross(n, p.m[0]) - on_trace * p.m[1];
    }
    g.log_scale = dm[0] * p.m[0] + dm[1] * p.m[1];
    let dt = array(dm[0] * p.s, dm[1] * p.s);
    var dr: mat3x3<f32>;
    for (var k = 0u; k < 3u; k++) { dr[k] = p.jw[0] * dt[0][k] + p.jw[1] * dt[1][k]; }
    g.quat = quaternion_gradient(p.q, p.rq, dr);
    // J·W = (f/z)·(Wᵢ − t·W₂): through the 1/z in front, and through t where it was not clamped.
    var camera = vec3(0.0);
    for (var i = 0u; i < 2u; i++) {
        let djw = p.r * dt[i];
        let j = task.focal[i] * p.rz;
        let through_t = select(0.0, -dot(djw, p.w[2]) * j * p.rz, p.inside[i]);
        let through_ray = on_screen[i] * j;
        camera[i] = through_t + through_ray;
        camera.z -= through_t * p.t[i] + through_ray * p.ray[i] + dot(djw, p.jw[i]) * p.rz;
    }
    g.mean = camera.x * p.w[0] + camera.y * p.w[1] + camera.z * p.w[2];
    g.logit = sum[0] * p.rest_opacity;
    return g;
}

// dL/d(colour) where the colour was not clipped at 0; adds to dL/d(mean) the part through the colour's direction.
fn through_colour(i: u32, at: vec4<f32>, basis: ptr<function, array<f32, 16>>, g: ptr<function, Gradient>) {
    let seen = colour(i, basis) > vec3(0.0);
    (*g).rgb = select(vec3(0.0), (*g).rgb, seen);
    if task.coeffs == 1u { return; }
    var weights: array<f32, 16>;
    for (var k = 1u; k < task.coeffs; k++) { weights[k] = dot(vector(SH + 3u * k, i), (*g).rgb); }
    let d = basis_gradient(at.xyz, &weights);
    (*g).mean += (d - at.xyz * dot(d, at.xyz)) * at.w;
}

fn anchored(k: u32, i: u32) -> f32 { return anchors[k * task.rows + i]; }

// Row `axis` of the anchor's frame.
fn frame_row(axis: u32, i: u32) -> vec3<f32> {
    let at = ANCHOR_FRAME + 3u * axis;
    return vec3(anchored(at, i), anchored(at + 1u, i), anchored(at + 2u, i));
}

// Adds the gradient of log(1 + [D² − 1]₊), D² = Σ (δ̃ᵢ/rᵢ)².
fn add_anchor(i: u32, g: ptr<function, Gradient>) {
    let reciprocal = vec3(vec2(anchored(ANCHOR_PARALLEL, i)), anchored(ANCHOR_PERP, i));
    var local = vec3(0.0);
    for (var j = 0u; j < 3u; j++) { local += frame_row(j, i) * (value(j, i) - anchored(j, i)); }
    local *= reciprocal;
    let squared = dot(local, local);
    if !(squared > 1.0) { return; }
    let pull = task.anchor * 2.0 / squared * local * reciprocal;
    for (var j = 0u; j < 3u; j++) { (*g).mean[j] += dot(pull, frame_row(j, i)); }
}

// Adds the gradient of [log s⊥ − log s̄⊥]₊, s⊥ = |S Rᵀ n̄|, in units of s̄⊥, whose square may not fit f32.
fn add_thickness(i: u32, p: Projected, g: ptr<function, Gradient>) {
    let normal = vec3(frame_row(0u, i).z, frame_row(1u, i).z, frame_row(2u, i).z);
    let scale = p.s * anchored(ANCHOR_PERP, i);
    let extent = (normal * p.r) * scale;
    let square = dot(extent, extent);
    if !(square > 1.0) { return; }
    let pull = task.thickness / square * extent;
    (*g).log_scale += pull * extent;
    let along = pull * scale;
    (*g).quat += quaternion_gradient(p.q, p.rq, mat3x3(normal * along.x, normal * along.y, normal * along.z));
}

// Adds the gradient of max(0, −log(r_eff − 1 + ε)), r_eff = exp(H), H = −Σ q log q, q = s/Σs.
fn add_rank(i: u32, g: ptr<function, Gradient>) {
    var below = vector(LOG_SCALE, i);
    let largest = max(below.x, max(below.y, below.z));
    below -= largest;
    var share = vec3(exponential(below.x), exponential(below.y), exponential(below.z));
    // Σs over the largest is 1 + others; the 1 is left out, for on a needle it would swallow the rest.
    var others = share.y + share.z;
    if below.x < 0.0 { others = share.x + select(share.y, share.z, below.y >= 0.0); }
    if !(others <= 1.0) { return; } // the rank is above 2
    let log_sum = log2_1p(others) * 0.6931472;
    share /= 1.0 + others;
    let entropy = log_sum - dot(share, below);
    // exp(H) − 1 by its series: exact where H is small, good enough up to log 2.
    var series = 1.0 / 40320.0;
    series = series * entropy + 1.0 / 5040.0;
    series = series * entropy + 1.0 / 720.0;
    series = series * entropy + 1.0 / 120.0;
    series = series * entropy + 1.0 / 24.0;
    series = series * entropy + 1.0 / 6.0;
    series = series * entropy + 0.5;
    series = series * entropy + 1.0;
    let rank_less_1 = series * entropy;
    if !(rank_less_1 < 1.0 - task.rank_offset) { return; }
    let slope = task.rank * (rank_less_1 + 1.0) / (rank_less_1 + task.rank_offset);
    (*g).log_scale += slope * share * (below - log_sum + entropy);
}

// Whether all gradients can be squared: by bits, because compilers may assume that none is NaN.
fn finite(v: vec4<f32>) -> bool {
    let a = abs(v);
    return bounded(a.x, GRADIENT_MAX) && bounded(a.y, GRADIENT_MAX) && bounded(a.z, GRADIENT_MAX) && bounded(a.w, GRADIENT_MAX);
}

// σ²/(σ² + finest²) · 1/(1 + (σ/reach)¹⁶) from σ², where σ is a size in pixels.
fn share_of(variance: f32) -> f32 {
    var share = 1.0;
    if task.finest > 0.0 {
        let v = min(variance, 1e12);
        share = v / (v + task.finest * task.finest);
    }
    if task.reach > 0.0 {
        // Beyond ten times the reach nothing moves anyway, and the eighth power stays within f32.
        let ratio = min(variance / task.reach / task.reach, 100.0);
        let fourth = ratio * ratio * ratio * ratio;
        share /= fourth * fourth + 1.0;
    }
    return share;
}

// Adam on one value; `bias`: 1/(1 − β₁ᵗ) and 1/√(1 − β₂ᵗ).
fn move_value(k: u32, i: u32, g: f32, rate: f32, bias: vec2<f32>) {
    let at = k * task.rows + i;
    let old = moments[at];
    let first = old.x + (g - old.x) * (1.0 - task.momentum);
    let second = old.y * 0.999 + g * g * 0.001;
    moments[at] = vec2(first, second);
    values[at] -= rate * bias.x * first / (sqrt(second) * bias.y + 1e-15);
}

@compute @workgroup_size(64)
fn update(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= task.rows || atomicLoad(&state[FAILED]) != 0u || rows[i].frozen != 0u { return; }
    let splat = splats[i];
    var sum: array<f32, 9>;
    var seen = false;
    for (var pair = splat.place; pair < splat.place + splat.tiles; pair++) {
        for (var k = 0u; k < 9u; k++) {
            sum[k] += sums[pair][k];
            seen = seen || bitcast<u32>(sums[pair][k]) << 1u != 0u;
        }
    }
    let regularized = task.anchor + task.thickness + task.rank > 0.0;
    if !seen && !regularized { return; }
    let p = project(i);
    let at = direction(i);
    var basis = basis_at(at.xyz);
    var g: Gradient;
    if seen {
        g = unproject(p, sum);
        g.rgb = vec3(sum[6], sum[7], sum[8]);
        through_colour(i, at, &basis, &g);
    }
    if task.anchor > 0.0 { add_anchor(i, &g); }
    if task.thickness > 0.0 { add_thickness(i, p, &g); }
    if task.rank > 0.0 { add_rank(i, &g); }
    let parts = array(vec4(g.mean, g.logit), g.quat, vec4(g.log_scale, 0.0), vec4(g.rgb, 0.0));
    var bits = vec4(0u);
    var sound = true;
    for (var k = 0u; k < 4u; k++) {
        bits |= bitcast<vec4<u32>>(parts[k]) << vec4(1u);
        sound = sound && finite(parts[k]);
    }
    if all(bits == vec4(0u)) { return; } // behind a mask, for example
    if !sound {
        atomicAdd(&state[SKIPPED], 1u);
        return;
    }
    atomicAdd(&state[UPDATED], 1u);
    let steps = rows[i].steps + 1u;
    rows[i].steps = steps;
    let bias = vec2(1.0 / (1.0 - pow(max(task.momentum, 1e-6), f32(steps))), biases[min(steps, arrayLength(&biases) - 1u)]);

    // Sizes on the screen before dilation, px²; 0 behind the near plane. The larger eigenvalue of MMᵀ is a root of squares.
    let shown = select(0.0, 1.0, p.depth >= task.near);
    let xx = dot(p.m[0], p.m[0]);
    let yy = dot(p.m[1], p.m[1]);
    let xy = dot(p.m[0], p.m[1]);
    let apart = 0.5 * (xx - yy);
    let share = share_of(shown * (0.5 * (xx + yy) + sqrt(apart * apart + xy * xy)));
    let axes = shown * (p.m[0] * p.m[0] + p.m[1] * p.m[1]);
    for (var k = 0u; k < 3u; k++) {
        move_value(k, i, g.mean[k], share * rows[i].unit * task.means, bias);
        move_value(LOG_SCALE + k, i, g.log_scale[k], share_of(axes[k]) * task.log_scales, bias);
        move_value(SH + k, i, basis[0] * g.rgb[k], task.sh0, bias);
    }
    for (var k = 0u; k < 4u; k++) { move_value(QUAT + k, i, g.quat[k], share * task.quats, bias); }
    move_value(LOGIT, i, g.logit, task.logits, bias);
    for (var k = 1u; k < task.coeffs; k++) {
        for (var c = 0u; c < 3u; c++) { move_value(SH + 3u * k + c, i, basis[k] * g.rgb[c], task.sh_n, bias); }
    }
}
