// Splats, nearest first, to the tiles that they meet. `count`: a thread looks up a splat's tiles. `expand`: the counts
// summed, a thread makes one pair of tile and splat; its number is its place. `starts`: sorted by tile, where each tile's
// pairs begin, and where each splat's began before.

@group(0) @binding(1) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read_write> before: array<u32>;
@group(0) @binding(4) var<storage, read_write> state: array<atomic<u32>>;
@group(0) @binding(5) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> places: array<u32>;
@group(0) @binding(7) var<storage, read_write> drawn: array<u32>;
@group(0) @binding(8) var<storage, read_write> first: array<u32>;
@group(0) @binding(9) var<storage, read_write> sums: array<array<f32, 9>>;

var<workgroup> total: atomic<u32>;

@compute @workgroup_size(64)
fn count(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let i = thread_of(id, groups, 64u);
    if t == 0u { atomicStore(&total, 0u); }
    workgroupBarrier();
    if i < task.rows {
        let tiles = splats[order[i]].tiles;
        before[i] = tiles;
        atomicAdd(&total, tiles);
    }
    workgroupBarrier();
    if t == 0u {
        let own = atomicLoad(&total);
        let others = atomicAdd(&state[TOTAL], own);
        // The sum of all may pass 2³²: one of the additions then does.
        if others + own < others || others + own > task.capacity { atomicMax(&state[FAILED], 1u); }
    }
}

// The tile of a splat's nth pair.
fn nth_tile(s: Splat, nth: u32) -> u32 {
    let e = ellipse_of(s);
    var left = nth;
    for (var row = e.rows.x; row < e.rows.y; row++) {
        let columns = columns_of(e, row);
        let count = columns.y - columns.x;
        if left < count { return row * tiles_across() + columns.x + left; }
        left -= count;
    }
    // Two kernels may round a splat's tiles differently: a pair beyond them goes to none.
    return tiles_across() * tiles_down();
}

@compute @workgroup_size(64)
fn expand(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    let none = tiles_across() * tiles_down();
    if i >= task.capacity { return; }
    keys[i] = vec2(none, 0u);
    places[i] = i;
    drawn[i] = 0u;
    if atomicLoad(&state[FAILED]) != 0u || i >= atomicLoad(&state[TOTAL]) { return; }
    // The last splat with no more pairs before it.
    var low = 0u;
    var high = task.rows;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if before[middle] <= i { low = middle; } else { high = middle; }
    }
    let row = order[low];
    drawn[i] = row;
    let tile = nth_tile(splats[row], i - before[low]);
    keys[i] = vec2(tile, 0u);
    // Images alone take no sums.
    if tile == none && i < arrayLength(&sums) { sums[i] = array<f32, 9>(); }
}

@compute @workgroup_size(64)
fn starts(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i < task.rows { splats[order[i]].place = before[i]; }
    let tiles = tiles_across() * tiles_down();
    if i > tiles { return; }
    let start = lower_bound(i);
    first[i] = start;
    if i < tiles && lower_bound(i + 1u) - start > task.most_in_tile { atomicMax(&state[FAILED], 2u); }
}

// How many pairs lie in earlier tiles.
fn lower_bound(tile: u32) -> u32 {
    var low = 0u;
    var high = task.capacity;
    while low < high {
        let middle = (low + high) / 2u;
        if keys[middle].x < tile { low = middle + 1u; } else { high = middle; }
    }
    return low;
}
