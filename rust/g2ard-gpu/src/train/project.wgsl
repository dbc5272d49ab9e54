// Gaussians → splats, by the formulas of g2ard_core::raster::project. `values` hold one attribute after the other.

const QUAT = 3u;
const LOG_SCALE = 7u;
const LOGIT = 10u;
const SH = 11u;

struct Projected {
    visible: bool,
    x: Two,
    y: Two,
    depth: f32,
    rz: f32,
    // x/z and y/z; `t` is clamped, `inside` says where it was not.
    ray: vec2<f32>,
    t: vec2<f32>,
    inside: vec2<bool>,
    // The camera's rotation and J·W, row by row.
    w: array<vec3<f32>, 3>,
    jw: array<vec3<f32>, 2>,
    // Unit quaternion (w, x, y, z) and 1/|q|, 0 for a zero quaternion.
    q: vec4<f32>,
    rq: f32,
    r: mat3x3<f32>,
    s: vec3<f32>,
    // J·W·R·S, row by row.
    m: array<vec3<f32>, 2>,
    minors: vec3<f32>,
    det0: f32,
    det: f32,
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    rest_opacity: f32, // 1 − opacity
}

fn value(k: u32, i: u32) -> f32 { return values[k * task.rows + i]; }

fn vector(k: u32, i: u32) -> vec3<f32> {
    return vec3(value(k, i), value(k + 1u, i), value(k + 2u, i));
}

// e^x, clamped to the normal range: the CPU's series, because those of devices have fewer digits.
fn exponential(given: f32) -> f32 {
    let x = clamp(given, -87.0, 88.0);
    let n = floor(x * 1.442695 + 0.5);
    let r = x - n * 0.6933594 + n * 2.1219444e-4;
    var p = 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    return p * power_of_two(i32(n));
}

// log2(1 + x) for 0 ≤ x ≤ 1, by 2·atanh(x / (2 + x)).
fn log2_1p(x: f32) -> f32 {
    let s = x / (x + 2.0);
    let t = s * s;
    var p = 1.0 / 15.0;
    p = p * t + 1.0 / 13.0;
    p = p * t + 1.0 / 11.0;
    p = p * t + 1.0 / 9.0;
    p = p * t + 1.0 / 7.0;
    p = p * t + 1.0 / 5.0;
    p = p * t + 1.0 / 3.0;
    p = p * t + 1.0;
    return p * s * 2.88539;
}

// In pairs of f32: a pixel coordinate in one is only good to 3e-5.
fn in_camera(mean: vec3<f32>, row: u32) -> Two {
    let r = task.rotation[row];
    let l = task.rotation_rest[row];
    var p = Two(r.w, l.w);
    for (var k = 0u; k < 3u; k++) { p = add(p, mul(Two(r[k], l[k]), single(mean[k]))); }
    return p;
}

struct Turn {
    q: vec4<f32>,
    rq: f32,
    r: mat3x3<f32>,
}

fn turn_of(i: u32) -> Turn {
    var q = vec4(value(QUAT, i), vector(QUAT + 1u, i));
    // Divided by the largest part first: squares of 1e±30 leave f32.
    let largest = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
    let some = largest > 0.0;
    let shrink = select(0.0, 1.0 / select(1.0, largest, some), some);
    q *= shrink;
    q.x = select(1.0, q.x, some);
    let rn = 1.0 / sqrt(dot(q, q));
    q *= rn;
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    let r = mat3x3( // its columns
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    return Turn(q, rn * shrink, r);
}

fn project(i: u32) -> Projected {
    hidden = task.zero;
    var o: Projected;
    let mean = vector(0u, i);
    let z = in_camera(mean, 2u);
    o.depth = z.x;
    o.visible = o.depth >= task.near;
    // Rows behind the camera go on with z = 1, so that nothing below is infinite.
    var rz = ONE;
    if o.visible { rz = div(ONE, z); }
    let ray_x = mul(in_camera(mean, 0u), rz);
    let ray_y = mul(in_camera(mean, 1u), rz);
    o.x = add(mul(ray_x, Two(task.focal.x, task.focal.z)), Two(task.center.x, task.center.z));
    o.y = add(mul(ray_y, Two(task.focal.y, task.focal.w)), Two(task.center.y, task.center.w));
    o.rz = rz.x;
    o.ray = vec2(ray_x.x, ray_y.x);
    o.t = clamp(o.ray, task.limits.xz, task.limits.yw);
    o.inside = o.ray == o.t;
    for (var k = 0u; k < 3u; k++) { o.w[k] = task.rotation[k].xyz; }
    o.jw[0] = o.rz * task.focal.x * (o.w[0] - o.t.x * o.w[2]);
    o.jw[1] = o.rz * task.focal.y * (o.w[1] - o.t.y * o.w[2]);
    let turn = turn_of(i);
    o.q = turn.q;
    o.rq = turn.rq;
    o.r = turn.r;
    let log_scales = vector(LOG_SCALE, i);
    o.s = vec3(exponential(log_scales.x), exponential(log_scales.y), exponential(log_scales.z));
    o.m[0] = o.jw[0] * o.r * o.s;
    o.m[1] = o.jw[1] * o.r * o.s;
    // Cauchy–Binet: xx·yy − xy² would lose every digit on a needle.
    o.minors = cross(o.m[0], o.m[1]);
    let xy = dot(o.m[0], o.m[1]);
    var xx = dot(o.m[0], o.m[0]);
    var yy = dot(o.m[1], o.m[1]);
    o.det0 = dot(o.minors, o.minors);
    o.det = o.det0 + DILATION * (xx + yy) + DILATION * DILATION;
    xx += DILATION;
    yy += DILATION;
    // log2 σ(x) and 1 − σ(x)
    let logit = value(LOGIT, i);
    let e = exponential(-abs(logit));
    o.rest_opacity = select(1.0, e, logit > 0.0) / (1.0 + e);
    o.log2_opacity = min(logit, 0.0) * 1.442695 - log2_1p(e);
    if task.antialiased != 0u { o.log2_opacity += 0.5 * log2(o.det0 / o.det); }
    let reach = o.log2_opacity - LOG2_ALPHA_MIN;
    o.c = sqrt(HALF_LOG2_E / yy);
    o.a = sqrt(HALF_LOG2_E * yy / o.det);
    o.b = -(xy / yy * o.a);
    let half = sqrt(vec2(xx, yy) * max(reach, 0.0) / HALF_LOG2_E) * 1.0001 + 0.01;
    let at = vec2(o.x.x, o.y.x);
    // By bits, because NaN and infinity may pass any comparison.
    o.visible = o.visible && bounded(o.det, 1e33) && bounded(reach, 1e30) && bounded(abs(at.x), 1e30)
        && bounded(abs(at.y), 1e30) && all(at + half >= vec2(0.5)) && all(vec2<f32>(task.size) - 0.5 >= at - half);
    return o;
}

// The unit direction from the camera, and 1/distance.
fn direction(i: u32) -> vec4<f32> {
    hidden = task.zero;
    var d: vec3<f32>;
    for (var k = 0u; k < 3u; k++) {
        d[k] = sub(single(value(k, i)), Two(task.eye[k], task.eye_rest[k])).x;
    }
    let r = 1.0 / sqrt(max(dot(d, d), 1e-30));
    return vec4(d * r, r);
}

const C0 = 0.28209479;
const C1 = 0.48860251;
const C2 = vec3(1.0925484, 0.31539157, 0.5462742);
const C3 = vec4(0.5900436, 2.8906114, 0.4570458, 0.37317633);

// Real spherical harmonics at the unit vector d; those past task.coeffs are 0.
fn basis_at(d: vec3<f32>) -> array<f32, 16> {
    var o: array<f32, 16>;
    let x = d.x;
    let y = d.y;
    let z = d.z;
    o[0] = C0;
    if task.coeffs > 1u {
        o[1] = -C1 * y;
        o[2] = C1 * z;
        o[3] = -C1 * x;
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    if task.coeffs > 4u {
        o[4] = C2.x * x * y;
        o[5] = -C2.x * y * z;
        o[6] = C2.y * (2.0 * zz - xx - yy);
        o[7] = -C2.x * x * z;
        o[8] = C2.z * (xx - yy);
    }
    if task.coeffs > 9u {
        o[9] = -C3.x * y * (3.0 * xx - yy);
        o[10] = C3.y * x * y * z;
        o[11] = -C3.z * y * (4.0 * zz - xx - yy);
        o[12] = C3.w * z * (2.0 * zz - 3.0 * (xx + yy));
        o[13] = -C3.z * x * (4.0 * zz - xx - yy);
        o[14] = 0.5 * C3.y * z * (xx - yy);
        o[15] = -C3.x * x * (xx - 3.0 * yy);
    }
    return o;
}

// 0.5 + Σ basis·SH, not clamped.
fn colour(i: u32, basis: ptr<function, array<f32, 16>>) -> vec3<f32> {
    var rgb = vec3(0.5);
    for (var k = 0u; k < task.coeffs; k++) { rgb += (*basis)[k] * vector(SH + 3u * k, i); }
    return rgb;
}
