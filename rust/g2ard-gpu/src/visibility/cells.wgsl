// Cells against the image. `want`: a thread lights the pixel of a cell's centre, so that its depth is worked
// out. `seen`: a thread compares 32 cells with the depth in their pixels; each is a bit of its answer.

@group(0) @binding(1) var<storage, read> centers: array<array<f32, 3>>;
@group(0) @binding(2) var<storage, read_write> light: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read> depth: array<f32>;
@group(0) @binding(4) var<storage, read_write> bits: array<u32>;

const NOWHERE = 0xffffffffu;

fn center(i: u32) -> vec3<f32> { return to_camera(vec3(centers[i][0], centers[i][1], centers[i][2])); }

@compute @workgroup_size(64)
fn want(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= view.count { return; }
    let pixel = pixel_of(center(i));
    if pixel != NOWHERE { atomicStore(&light[pixel], bitcast<u32>(1.0)); }
}

@compute @workgroup_size(64)
fn seen(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let word = thread_of(id, groups, 64u);
    if 32u * word >= view.count { return; }
    var found = 0u;
    for (var bit = 0u; bit < min(32u, view.count - 32u * word); bit++) {
        let t = center(32u * word + bit);
        let pixel = pixel_of(t);
        if pixel == NOWHERE { continue; }
        let median = depth[pixel];
        let near = median > 0.0 && abs(t.z - median) <= max(view.cell, view.tolerance * t.z);
        found |= u32(near) << bit;
    }
    bits[word] = found;
}
