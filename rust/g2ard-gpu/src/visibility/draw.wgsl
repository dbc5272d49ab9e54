// A tile's splats, nearest first: a workgroup takes a tile, a thread a pixel. A dispatch draws view.pairs of each tile's
// from the view.first-th on. `depths`: the depth at which less than half the light is left; pixels that nobody asks for
// start without any. `weigh`: what each pair adds to Σ αT².

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> numbers: array<u32>;
@group(0) @binding(3) var<storage, read> drawn: array<u32>;
@group(0) @binding(4) var<storage, read> bounds: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> light: array<f32>; // 0 where a pixel has ended
@group(0) @binding(6) var<storage, read_write> found: array<f32>; // depths of pixels, or weights of pairs

const ALPHA_MIN = 1.0 / 255.0;
const BATCH = 8u;

var<workgroup> range: vec2<u32>;
var<workgroup> parts: array<f32, 2048>;
var<workgroup> sums: array<f32, 256>;
var<workgroup> lit: atomic<u32>;
var<workgroup> last_lit: u32;

fn within(at: u32, span: u32) -> bool { return at >= (span & 0xffffu) && at < (span >> 16u); }

// 0 below the least that counts.
fn alpha_of(s: Splat, pixel: vec2<u32>) -> f32 {
    if !within(pixel.x, s.columns) || !within(pixel.y, s.rows) { return 0.0; }
    let dx = f32(pixel.x) + 0.5 - s.x;
    let dy = f32(pixel.y) + 0.5 - s.y;
    let u = s.a * dx + s.b * dy;
    let v = s.c * dy;
    let power = min(u * u + v * v, 126.0); // a finite number, and no subnormal result
    let alpha = min(s.opacity * exp2(-power), view.alpha_max);
    return select(alpha, 0.0, alpha < ALPHA_MIN);
}

fn range_of(tile: u32) -> vec2<u32> {
    let all = bounds[tile];
    let first = min(all.x + view.first, all.y);
    return vec2(first, first + min(view.pairs, all.y - first));
}

@compute @workgroup_size(16, 16)
fn depths(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let tile = block_of(group, groups);
    let across = tiles_across();
    let pixel = TILE * vec2(tile % across, tile / across) + local.xy;
    if any(pixel >= view.size) { return; }
    let at = pixel.y * view.size.x + pixel.x;
    var left = light[at];
    if left < view.light_min { return; }
    let span = range_of(tile);
    for (var i = span.x; i < span.y; i++) {
        let s = splats[drawn[numbers[i]]];
        left *= 1.0 - alpha_of(s, pixel);
        if left < view.light_min {
            found[at] = s.z;
            break;
        }
    }
    light[at] = left;
}

@compute @workgroup_size(16, 16)
fn weigh(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let tile = block_of(group, groups);
    let across = tiles_across();
    let pixel = TILE * vec2(tile % across, tile / across) + local.xy;
    let at = pixel.y * view.size.x + pixel.x;
    let inside = all(pixel < view.size);
    var left = 0.0;
    if inside { left = light[at]; }
    if t == 0u {
        range = vec2(0u);
        if tile < arrayLength(&bounds) { range = range_of(tile); }
        atomicStore(&lit, 0u);
    }
    let span = workgroupUniformLoad(&range);
    for (var first = span.x; first < span.y; first += BATCH) {
        for (var k = 0u; k < BATCH; k++) {
            var weight = 0.0;
            if left > 0.0 && first + k < span.y {
                let alpha = alpha_of(splats[drawn[numbers[first + k]]], pixel);
                let next = left * (1.0 - alpha);
                weight = alpha * left * left;
                left = next;
                if next <= view.light_min {
                    weight = 0.0;
                    left = 0.0;
                }
            }
            parts[256u * k + t] = weight;
        }
        if left > 0.0 { atomicStore(&lit, first + 1u); }
        workgroupBarrier();
        // Thirty-two threads sum a pair's 256 pixels, then one of them.
        var sum = 0.0;
        for (var k = 0u; k < 8u; k++) { sum += parts[8u * t + k]; }
        sums[t] = sum;
        if t == 0u { last_lit = atomicLoad(&lit); }
        let last = workgroupUniformLoad(&last_lit);
        if t < BATCH && first + t < span.y {
            var total = 0.0;
            for (var k = 0u; k < 32u; k++) { total += sums[32u * t + k]; }
            found[numbers[first + t]] = total;
        }
        if last != first + 1u { break; }
    }
    if inside { light[at] = left; }
}
