// Exclusive prefix sums. A workgroup takes 1024 values, four a thread, and leaves their total in `totals`;
// the totals are scanned in the same way and added back.

@group(0) @binding(0) var<uniform> count: vec4<u32>;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

var<workgroup> sums: array<u32, 256>;

@compute @workgroup_size(256)
fn scan(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    let first = 1024u * block + 4u * t;
    var mine: array<u32, 4>;
    var sum = 0u;
    for (var k = 0u; k < 4u; k++) {
        mine[k] = sum;
        if first + k < count.x { sum += values[first + k]; }
    }
    sums[t] = sum;
    workgroupBarrier();
    for (var reach = 1u; reach < 256u; reach *= 2u) {
        var before = 0u;
        if t >= reach { before = sums[t - reach]; }
        workgroupBarrier();
        sums[t] += before;
        workgroupBarrier();
    }
    let before = sums[t] - sum;
    for (var k = 0u; k < 4u; k++) {
        if first + k < count.x { values[first + k] = before + mine[k]; }
    }
    if t == 255u && block < arrayLength(&totals) { totals[block] = sums[255]; }
}

@compute @workgroup_size(256)
fn add_totals(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    if 1024u * block >= count.x { return; }
    let before = totals[block];
    for (var k = 0u; k < 4u; k++) {
        let at = 1024u * block + 256u * k + t;
        if at < count.x { values[at] += before; }
    }
}
