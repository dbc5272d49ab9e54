// Cells of one size. `keys`: a thread finds the Morton code of a row's cell, in double precision throughout.
// `octaves` and `edges` compare neighbours in sorted order; `compact` lists where each cell begins.

struct Lattice {
    origin: array<vec4<u32>, 2>, // x, y; z, radius: as F64
    size: F64,
    first: u32, // where this piece's rows begin among all
    count: u32,
    clamped: u32, // whether points beyond the lattice go onto its faces
    outside: u32, // the code of those that do not
}

@group(0) @binding(0) var<uniform> lattice: Lattice;
@group(0) @binding(1) var<storage, read> points: array<array<F64, 3>>;
@group(0) @binding(2) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> rows: array<u32>;

const LAST = 0x1fffffu;

// floor(x) of a double: below 0, 0 … 2²¹ − 1, or beyond, as i32.
fn floor_cell(x: F64) -> i32 {
    if exponent(x) == 0 { return 0; }
    if (x.y >> 31u) != 0u { return -1; }
    let e = exponent(x) - 1023;
    if e < 0 { return 0; }
    if e > 20 { return i32(LAST) + 1; }
    return i32(mantissa(x).y >> u32(20 - e));
}

// Every third bit of the result is one of the lower ten of v.
fn spread(v: u32) -> u32 {
    var x = v & 0x3ffu;
    x = (x | (x << 16u)) & 0x030000ffu;
    x = (x | (x << 8u)) & 0x0300f00fu;
    x = (x | (x << 4u)) & 0x030c30c3u;
    return (x | (x << 2u)) & 0x09249249u;
}

fn spread3(v: vec3<u32>) -> u32 { return spread(v.x) | (spread(v.y) << 1u) | (spread(v.z) << 2u); }

fn morton(v: vec3<u32>) -> vec2<u32> {
    let low = spread3(v);
    let middle = spread3(v >> vec3(10u));
    return vec2(low | (middle << 30u), (middle >> 2u) | (spread3(v >> vec3(20u)) << 28u));
}

@compute @workgroup_size(64)
fn find_keys(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 64u);
    if i >= lattice.count { return; }
    var origin = array<F64, 3>(lattice.origin[0].xy, lattice.origin[0].zw, lattice.origin[1].xy);
    let radius = lattice.origin[1].zw;
    var cell: vec3<u32>;
    var inside = true;
    for (var k = 0u; k < 3u; k++) {
        let c = floor_cell(div(add(sub(points[i][k], origin[k]), radius), lattice.size));
        inside &= c >= 0 && c <= i32(LAST);
        cell[k] = u32(clamp(c, 0, i32(LAST)));
    }
    let found = inside || lattice.clamped != 0u;
    keys[lattice.first + i] = select(vec2(lattice.outside), morton(cell), found);
    rows[lattice.first + i] = lattice.first + i;
}
