// A thread projects a Gaussian to its splat, whose depth is its sorting key.

@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(3) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> order: array<u32>;

@compute @workgroup_size(64)
fn splat(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= task.rows { return; }
    let p = project(i);
    var s: Splat;
    var key = 0xffffffffu; // behind all that is visible
    if p.visible {
        key = bitcast<u32>(p.depth);
        var basis = basis_at(direction(i).xyz);
        let rgb = max(colour(i, &basis), vec3(0.0));
        s = Splat(p.x.x, p.x.y, p.y.x, p.y.y, p.a, p.b, p.c, p.log2_opacity, array(rgb.x, rgb.y, rgb.z), 0u, 0u);
        s.tiles = tile_count(s);
    }
    splats[i] = s;
    keys[i] = vec2(key, 0u);
    order[i] = i;
}
