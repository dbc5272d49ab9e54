// Splats, nearest first, to the tiles that they touch. `count`: a thread counts a splat's tiles. `expand`: the
// counts summed, a thread makes one pair of tile and splat; its number says which. `ranges`: sorted by tile,
// where each tile's pairs lie. `collect`: a thread adds what a splat's pairs weigh to its row.

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read_write> before: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> numbers: array<u32>;
@group(0) @binding(6) var<storage, read_write> drawn: array<u32>;
@group(0) @binding(7) var<storage, read_write> bounds: array<vec2<u32>>;
@group(0) @binding(8) var<storage, read_write> shares: array<f32>;
@group(0) @binding(9) var<storage, read_write> weights: array<f32>;

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i < view.count { before[i] = tile_count(splats[order[i]]); }
}

@compute @workgroup_size(64)
fn expand(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= view.pairs { return; }
    let pair = view.first + i;
    // The last splat with no more pairs before it.
    var low = 0u;
    var high = view.count;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if before[middle] <= pair { low = middle; } else { high = middle; }
    }
    let s = splats[order[low]];
    let columns = tile_span(s.columns);
    let nth = pair - before[low];
    let rows = tile_span(s.rows);
    // Two kernels project a splat, and may round its span differently: a pair beyond its tiles goes to none.
    var tile = tiles_across() * tiles_down();
    if nth < columns.y * rows.y {
        tile = (rows.x + nth / columns.y) * tiles_across() + columns.x + nth % columns.y;
    }
    keys[i] = vec2(tile, 0u);
    numbers[i] = i;
    drawn[i] = order[low];
}

@compute @workgroup_size(64)
fn ranges(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= view.pairs { return; }
    let tile = keys[i].x;
    if tile >= arrayLength(&bounds) { return; }
    if i == 0u || keys[i - 1u].x != tile { bounds[tile].x = i; }
    if i + 1u == view.pairs || keys[i + 1u].x != tile { bounds[tile].y = i + 1u; }
}

@compute @workgroup_size(64)
fn collect(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= view.count { return; }
    var end = view.all_pairs;
    if i + 1u < view.count { end = before[i + 1u]; }
    end = min(end, view.first + view.pairs);
    var sum = 0.0;
    for (var pair = max(before[i], view.first); pair < end; pair++) { sum += shares[pair - view.first]; }
    if sum > 0.0 { weights[splats[order[i]].row] += sum; }
}
