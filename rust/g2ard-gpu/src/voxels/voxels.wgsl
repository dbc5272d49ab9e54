// Cells of one size: a thread finds the Morton code of a row's cell, in integers throughout.

struct Lattice {
    x: vec2<u32>, // the corner; 64-bit integers, as points are
    y: vec2<u32>,
    z: vec2<u32>,
    per_unit: u32, // cells per unit, times 2^shift
    shift: u32,
    first: u32, // where this piece's rows begin among all
    count: u32,
    clamped: u32, // whether points beyond the lattice go onto its faces
    outside: u32, // the code of those that do not
}

@group(0) @binding(0) var<uniform> lattice: Lattice;
@group(0) @binding(1) var<storage, read> points: array<array<vec2<u32>, 3>>;
@group(0) @binding(2) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> rows: array<u32>;

const LAST = 0x1fffffu;

// All 64 bits of a product.
fn wide(a: u32, b: u32) -> vec2<u32> {
    let al = a & 0xffffu; let ah = a >> 16u;
    let bl = b & 0xffffu; let bh = b >> 16u;
    let low = al * bl;
    let mid = ah * bl + (low >> 16u); // at most 0xffff² + 0xffff: no overflow
    let mix = al * bh + (mid & 0xffffu);
    return vec2((mix << 16u) | (low & 0xffffu), ah * bh + (mid >> 16u) + (mix >> 16u));
}

// The cell along an axis: −1 below 0, 2²¹ beyond the last.
fn cell_of(point: vec2<u32>, corner: vec2<u32>) -> i32 {
    let d = vec2(point.x - corner.x, point.y - corner.y - u32(point.x < corner.x));
    if (d.y >> 31u) != 0u { return -1; }
    // (d · per_unit) / 2³², without the lowest word.
    let carry = wide(d.x, lattice.per_unit).y;
    var n = wide(d.y, lattice.per_unit);
    n.x += carry;
    n.y += u32(n.x < carry);
    let shift = lattice.shift - 32u;
    if shift >= 32u {
        n = vec2(n.y >> (shift - 32u), 0u);
    } else if shift > 0u {
        n = vec2((n.x >> shift) | (n.y << (32u - shift)), n.y >> shift);
    }
    if n.y != 0u || n.x > LAST { return i32(LAST) + 1; }
    return i32(n.x);
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
    let at = points[i];
    let c = vec3(cell_of(at[0], lattice.x), cell_of(at[1], lattice.y), cell_of(at[2], lattice.z));
    let inside = all(c >= vec3(0)) && all(c <= vec3(i32(LAST)));
    let cell = vec3<u32>(clamp(c, vec3(0), vec3(i32(LAST))));
    let found = inside || lattice.clamped != 0u;
    keys[lattice.first + i] = select(vec2(lattice.outside), morton(cell), found);
    rows[lattice.first + i] = lattice.first + i;
}
