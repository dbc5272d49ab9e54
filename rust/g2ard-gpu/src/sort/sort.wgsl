// One pass of a stable radix sort: 64-bit keys with a word each, by four bits.
//
// `count_digits`: a workgroup counts the digits of its 1024 keys. Scanned, digit by digit over all workgroups,
// the counts say where each workgroup's keys go. `scatter`: a workgroup ranks its keys and moves them there.

struct Pass {
    count: u32,
    shift: u32,
    blocks: u32,
}

@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> keys: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;
@group(0) @binding(3) var<storage, read> words: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> sorted_words: array<u32>;

var<workgroup> digits: array<atomic<u32>, 16>;
// For each thread how often each digit comes up to and with it, two digits a word.
var<workgroup> before: array<array<u32, 8>, 256>;

fn digit(key: vec2<u32>) -> u32 {
    let word = select(key.x >> (pass_.shift & 31u), key.y >> (pass_.shift & 31u), pass_.shift >= 32u);
    return word & 15u;
}

@compute @workgroup_size(256)
fn count_digits(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    if t < 16u { atomicStore(&digits[t], 0u); }
    workgroupBarrier();
    for (var k = 0u; k < 4u; k++) {
        let at = 1024u * block + 256u * k + t;
        if at < pass_.count { atomicAdd(&digits[digit(keys[at])], 1u); }
    }
    workgroupBarrier();
    if t < 16u && block < pass_.blocks { counts[t * pass_.blocks + block] = atomicLoad(&digits[t]); }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    let first = 1024u * block + 4u * t;
    var mine: array<vec2<u32>, 4>;
    var own: array<u32, 8>;
    for (var k = 0u; k < 4u; k++) {
        if first + k < pass_.count {
            mine[k] = keys[first + k];
            let d = digit(mine[k]);
            own[d >> 1u] += 1u << (16u * (d & 1u));
        }
    }
    before[t] = own;
    workgroupBarrier();
    for (var reach = 1u; reach < 256u; reach *= 2u) {
        var sum = before[t];
        if t >= reach {
            for (var w = 0u; w < 8u; w++) { sum[w] += before[t - reach][w]; }
        }
        workgroupBarrier();
        before[t] = sum;
        workgroupBarrier();
    }
    var rank = before[t];
    for (var w = 0u; w < 8u; w++) { rank[w] -= own[w]; }
    for (var k = 0u; k < 4u; k++) {
        if first + k < pass_.count {
            let d = digit(mine[k]);
            let half = 16u * (d & 1u);
            let to = counts[d * pass_.blocks + block] + ((rank[d >> 1u] >> half) & 0xffffu);
            rank[d >> 1u] += 1u << half;
            sorted_keys[to] = mine[k];
            sorted_words[to] = words[first + k];
        }
    }
}
