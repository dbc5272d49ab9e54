// Rows as splats. `mark`: a thread marks a row that the image may show; a workgroup sums the tiles of its 256.
// `gather`: marked rows, in order, become splats with their depth as sorting key.

struct Row {
    mean: array<f32, 3>,
    opacity: f32,
    axes: array<array<f32, 3>, 3>, // each a standard deviation long
}

@group(0) @binding(1) var<storage, read> rows: array<Row>;
@group(0) @binding(2) var<storage, read_write> marks: array<u32>;
@group(0) @binding(3) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(5) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> order: array<u32>;

const HALF_LOG2_E = 0.72134752;

var<workgroup> sum: atomic<u32>;

// Pixels whose centres lie within `reach` of `at`, packed; 0 for none.
fn span(at: f32, reach: f32, count: u32) -> u32 {
    let last = f32(count);
    let low = clamp(at - reach - 0.5, -1.0, last);
    let high = clamp(at + reach - 0.5, -1.0, last);
    let start = u32(max(ceil(low), 0.0));
    let end = min(u32(max(floor(high) + 1.0, 0.0)), count);
    return select(0u, start | (end << 16u), start < end);
}

fn vector(v: array<f32, 3>) -> vec3<f32> { return vec3(v[0], v[1], v[2]); }

// A splat that no pixel shows has no rows.
fn project(i: u32) -> Splat {
    var s: Splat;
    let row = rows[i];
    let t = to_camera(vector(row.mean));
    if t.z <= view.near { return s; }
    let reach = 2.0 * log(row.opacity * 255.0);
    let at = view.focal * t.xy / t.z + view.center;
    let u = clamp(t.x / t.z, view.limits.x, view.limits.y);
    let v = clamp(t.y / t.z, view.limits.z, view.limits.w);
    let jx = view.focal.x / t.z * (view.rotation[0].xyz - u * view.rotation[2].xyz);
    let jy = view.focal.y / t.z * (view.rotation[1].xyz - v * view.rotation[2].xyz);
    let axes = mat3x3(vector(row.axes[0]), vector(row.axes[1]), vector(row.axes[2]));
    let mx = jx * axes;
    let my = jy * axes;
    let minors = cross(mx, my);
    let xx = dot(mx, mx);
    let yy = dot(my, my);
    // Cauchy–Binet: xx·yy − xy² would lose every digit on a needle.
    let det = dot(minors, minors) + DILATION * (xx + yy) + DILATION * DILATION;
    if !(reach >= 0.0 && bounded(det, 1e33)) { return s; }
    if !(bounded(abs(at.x), 1e30) && bounded(abs(at.y), 1e30)) { return s; }
    s.columns = span(at.x, sqrt(reach * (xx + DILATION)), view.size.x);
    s.rows = span(at.y, sqrt(reach * (yy + DILATION)), view.size.y);
    if s.columns == 0u { s.rows = 0u; }
    s.x = at.x;
    s.y = at.y;
    s.a = sqrt(HALF_LOG2_E * (yy + DILATION) / det);
    s.b = -dot(mx, my) / (yy + DILATION) * s.a;
    s.c = sqrt(HALF_LOG2_E / (yy + DILATION));
    s.opacity = row.opacity;
    s.z = t.z;
    s.row = i;
    return s;
}

@compute @workgroup_size(256)
fn mark(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    let i = 256u * block + t;
    if t == 0u { atomicStore(&sum, 0u); }
    workgroupBarrier();
    if i < view.count {
        let s = project(i);
        marks[i] = u32(s.rows != 0u);
        if s.rows != 0u { atomicAdd(&sum, tile_count(s)); }
    }
    workgroupBarrier();
    if t == 0u && 256u * block < view.count { tiles[block] = atomicLoad(&sum); }
}

// `marks` are summed by now: a row's is its place, and it is marked if the next row's differs.
@compute @workgroup_size(256)
fn gather(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 256u);
    if i >= view.count { return; }
    let to = marks[i];
    if marks[i + 1u] == to { return; }
    let s = project(i);
    splats[to] = s;
    keys[to] = vec2(bitcast<u32>(s.z), 0u);
    order[to] = to;
}
