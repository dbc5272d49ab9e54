// Members of groups, in the order of their groups: a thread takes one, and copies its row if this piece of the rows
// holds it. `points` for cells; `colored` for energy.wgsl; `weighed` for merge.wgsl.

struct Attributes {
    mass: F64,
    color: array<u32, 3>, // SH of band 0; bits of f32, as the others
    scales: array<u32, 3>,
    quat: array<u32, 4>,
}

struct Colored {
    mean: array<F64, 3>,
    color: array<F64, 3>,
}

struct Weighed {
    mean: array<F64, 3>,
    weight: F64,
    quat: array<u32, 4>,
    scales: array<u32, 3>,
    spare: u32,
}

struct Piece {
    first: u32, // the number of its first row
    count: u32,
    members: u32, // how many there are
}

@group(0) @binding(0) var<uniform> piece: Piece;
@group(0) @binding(1) var<storage, read> means: array<array<F64, 3>>;
@group(0) @binding(2) var<storage, read> attributes: array<Attributes>;
@group(0) @binding(3) var<storage, read> numbers: array<u32>;
@group(0) @binding(4) var<storage, read_write> points: array<array<F64, 3>>;
@group(0) @binding(5) var<storage, read_write> colored: array<Colored>;
@group(0) @binding(6) var<storage, read_write> weighed: array<Weighed>;

const HALF = F64(0u, 0x3fe00000u);
const SH_C0 = F64(0x50429b6du, 0x3fd20dd7u); // 0.28209479177387814
const ELSEWHERE = 0xffffffffu;

// Where this piece holds a member.
fn place(i: u32) -> u32 {
    if i >= piece.members { return ELSEWHERE; }
    let at = numbers[i] - piece.first; // of rows before it, too large a number
    return select(ELSEWHERE, at, at < piece.count);
}

@compute @workgroup_size(64)
fn gather_points(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    let at = place(i);
    if at != ELSEWHERE { points[i] = means[at]; }
}

@compute @workgroup_size(64)
fn gather_colored(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    let at = place(i);
    if at == ELSEWHERE { return; }
    colored[i].mean = means[at];
    for (var k = 0; k < 3; k++) {
        let c = add(HALF, mul(SH_C0, widen(attributes[at].color[k])));
        colored[i].color[k] = select(select(c, ZERO, lt(c, ZERO)), ONE, lt(ONE, c));
    }
}

@compute @workgroup_size(64)
fn gather_weighed(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    let at = place(i);
    if at == ELSEWHERE { return; }
    let l = attributes[at];
    weighed[i] = Weighed(means[at], l.mass, l.quat, l.scales, 0u);
}
