// What neighbours in sorted order tell. `octaves`: a workgroup counts, of its 1024 pairs, at which octave they
// first fall apart. `edges`: a thread marks the first row of a cell. `compact`: with the marks summed, a thread
// writes down where a cell begins, and its code.

@group(0) @binding(0) var<uniform> count: vec4<u32>;
@group(0) @binding(1) var<storage, read> keys: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranks: array<u32>;
@group(0) @binding(4) var<storage, read_write> starts: array<u32>;
@group(0) @binding(5) var<storage, read_write> codes: array<vec2<u32>>;

const OUTSIDE = vec2(0xffffffffu);
var<workgroup> apart: array<atomic<u32>, 22>;

@compute @workgroup_size(256)
fn octaves(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    if t < 22u { atomicStore(&apart[t], 0u); }
    workgroupBarrier();
    for (var k = 0u; k < 4u; k++) {
        let i = 1024u * block + 256u * k + t;
        if i > 0u && i < count.x {
            let bits = keys[i] ^ keys[i - 1u];
            if (bits.x | bits.y) != 0u {
                let first = select(firstLeadingBit(bits.x), 32u + firstLeadingBit(bits.y), bits.y != 0u);
                atomicAdd(&apart[first / 3u], 1u);
            }
        }
    }
    workgroupBarrier();
    if t < 22u && 1024u * block < count.x { counts[22u * block + t] = atomicLoad(&apart[t]); }
}

// Points beyond the lattice are a cell each.
fn begins(i: u32) -> bool {
    return i == 0u || any(keys[i] != keys[i - 1u]) || all(keys[i] == OUTSIDE);
}

@compute @workgroup_size(64)
fn edges(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 64u);
    if i < count.x { ranks[i] = u32(begins(i)); }
}

@compute @workgroup_size(64)
fn compact(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let i = thread_of(id, groups, 64u);
    if i < count.x && begins(i) {
        starts[ranks[i]] = i;
        codes[ranks[i]] = keys[i];
    }
}
