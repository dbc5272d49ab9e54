// Rows as splats. `mark`: a thread marks a row that the image may show; a workgroup sums the tiles of its 256.
// `depths`: the marked rows by the upper bits of their depth. `gather`: marked rows, in order, become splats with
// their depth as sorting key.

struct Row {
    mean: array<f32, 3>,
    opacity: f32,
    covariance: array<f32, 6>,
    trace: f32,
    reach: f32,
}

@group(0) @binding(1) var<storage, read> rows: array<Row>;
@group(0) @binding(2) var<storage, read_write> marks: array<u32>;
@group(0) @binding(3) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> histogram: array<atomic<u32>>;
@group(0) @binding(5) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(6) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read_write> order: array<u32>;

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

fn beyond(at: f32, size: u32, scale: f32, t: f32, row: Row) -> bool {
    let d = at - clamp(at, 0.0, f32(size));
    return d * d > row.reach * (row.trace * scale * scale * (1.0 + t * t) + DILATION);
}

fn apply(s: array<f32, 6>, j: vec3<f32>) -> vec3<f32> {
    return vec3(
        s[0] * j.x + s[1] * j.y + s[2] * j.z,
        s[1] * j.x + s[3] * j.y + s[4] * j.z,
        s[2] * j.x + s[4] * j.y + s[5] * j.z,
    );
}

// A splat that no pixel shows has no rows.
fn project(row: Row) -> Splat {
    var s: Splat;
    let t = to_camera(vec3(row.mean[0], row.mean[1], row.mean[2]));
    if t.z <= view.near { return s; }
    let at = view.focal * t.xy / t.z + view.center;
    let u = clamp(t.x / t.z, view.limits.x, view.limits.y);
    let v = clamp(t.y / t.z, view.limits.z, view.limits.w);
    let a = view.focal.x / t.z;
    let b = view.focal.y / t.z;
    if beyond(at.x, view.size.x, a, u, row) || beyond(at.y, view.size.y, b, v, row) { return s; }
    let jx = a * (view.rotation[0].xyz - u * view.rotation[2].xyz);
    let jy = b * (view.rotation[1].xyz - v * view.rotation[2].xyz);
    let sx = apply(row.covariance, jx);
    let sy = apply(row.covariance, jy);
    let xx = sx.x * jx.x + sx.y * jx.y + sx.z * jx.z + DILATION;
    let xy = sx.x * jy.x + sx.y * jy.y + sx.z * jy.z;
    let yy = sy.x * jy.x + sy.y * jy.y + sy.z * jy.z + DILATION;
    let det = xx * yy - xy * xy;
    if !(det > 0.0 && det < 3.0e38) { return s; }
    s.columns = span(at.x, sqrt(row.reach * xx), view.size.x);
    s.rows = span(at.y, sqrt(row.reach * yy), view.size.y);
    if s.columns == 0u { s.rows = 0u; }
    s.x = at.x;
    s.y = at.y;
    s.conic = array<f32, 3>(yy / det, -xy / det, xx / det);
    s.opacity = row.opacity;
    s.z = t.z;
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
        let s = project(rows[i]);
        let depth = bitcast<u32>(s.z);
        let shown = s.rows != 0u && depth >= view.start && depth < view.end;
        marks[view.first + i] = u32(shown);
        if shown { atomicAdd(&sum, tile_count(s)); }
    }
    workgroupBarrier();
    if t == 0u && 256u * block < view.count { tiles[view.first / 256u + block] = atomicLoad(&sum); }
}

@compute @workgroup_size(256)
fn depths(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 256u);
    if i >= view.count { return; }
    let s = project(rows[i]);
    if s.rows != 0u { atomicAdd(&histogram[bitcast<u32>(s.z) >> 19u], 1u); }
}

// `marks` are summed by now: a row's is its place, and it is marked if the next row's differs.
@compute @workgroup_size(256)
fn gather(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 256u);
    if i >= view.count { return; }
    let at = view.first + i;
    let to = marks[at];
    if marks[at + 1u] == to { return; }
    let s = project(rows[i]);
    splats[to] = s;
    keys[to] = vec2(bitcast<u32>(s.z), 0u);
    order[to] = to;
}
