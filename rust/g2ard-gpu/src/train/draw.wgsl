// A tile's splats. `draw`, front to back: a workgroup takes a tile, a thread a pixel. After every bucket of pairs it stores
// the pixel's light and, in the end, the colour behind the bucket. `show` draws and stores the image alone. `backward`, back
// to front: a workgroup takes a bucket, a thread a pair; the pixels pass through the threads from the last pair to the first.
// A pair's sums go to its place.

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> drawn: array<u32>;
@group(0) @binding(3) var<storage, read> places: array<u32>;
@group(0) @binding(4) var<storage, read> first: array<u32>;
@group(0) @binding(5) var<storage, read_write> image: array<f32>; // `backward`: the gradient
@group(0) @binding(6) var<storage, read_write> behind: array<vec4<f32>>; // each pixel's colour behind a bucket, and light
@group(0) @binding(7) var<storage, read_write> last: array<u32>; // pairs of the tile up to each pixel's last one
@group(0) @binding(8) var<storage, read_write> sums: array<array<f32, 9>>;

// A pair's splat relative to the tile's first pixel centre.
struct Pair {
    u: f32,
    v: f32,
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    rgb: vec3<f32>,
}

fn pair_at(i: u32, corner: vec2<u32>) -> Pair {
    hidden = task.zero;
    let s = splats[drawn[places[i]]];
    let center = vec2<f32>(corner) + 0.5;
    // In pairs of f32: far from the centre of a needle u is a small difference of large numbers.
    let dx = sub(single(center.x), Two(s.x, s.x_rest));
    let dy = sub(single(center.y), Two(s.y, s.y_rest));
    let u = add(mul(single(s.a), dx), mul(single(s.b), dy));
    let v = mul(single(s.c), dy);
    return Pair(u.x, v.x, s.a, s.b, s.c, s.log2_opacity, vec3(s.rgb[0], s.rgb[1], s.rgb[2]));
}

// (u, v, log2 α before clipping) at a pixel of the tile.
fn reach(p: Pair, at: vec2<u32>) -> vec3<f32> {
    let x = vec2<f32>(at);
    let u = p.a * x.x + (p.b * x.y + p.u);
    let v = p.c * x.y + p.v;
    return vec3(u, v, p.log2_opacity - v * v - u * u);
}

// Buckets of earlier tiles, and perhaps more: each tile has as many as it needs.
fn first_bucket(tile: u32) -> u32 { return first[tile] / BUCKET + tile; }

var<workgroup> pairs: array<Pair, 32>;
var<workgroup> lit: atomic<u32>;
var<workgroup> extent: vec2<u32>;

// The first pixel of a tile; its pairs, first and end, go to `extent`.
fn begin(tile: u32, t: u32) -> vec2<u32> {
    let across = tiles_across();
    if t == 0u {
        extent = vec2(0u);
        if tile < across * tiles_down() { extent = vec2(first[tile], first[tile + 1u]); }
    }
    return TILE * vec2(tile % across, tile / across);
}

// Fetch a bucket's pairs for the workgroup.
fn fetch(start: u32, count: u32, corner: vec2<u32>, t: u32) {
    if t < count { pairs[t] = pair_at(start + t, corner); }
    if t == 0u { atomicStore(&lit, 0u); }
    workgroupBarrier();
}

struct Light {
    // What would remain if no pixel ever stopped: a stopped pixel's only falls further below the minimum.
    now: f32,
    left: f32,
    reached: u32, // pairs of the tile up to the last one that the pixel shows
}

// The colour that the fetched pairs, after `before` others, show at a pixel.
fn blend(count: u32, before: u32, at: vec2<u32>, light: ptr<function, Light>) -> vec3<f32> {
    var rgb = vec3(0.0);
    for (var k = 0u; k < count; k++) {
        let log2_alpha = reach(pairs[k], at).z;
        if log2_alpha < LOG2_ALPHA_MIN { continue; }
        let alpha = min(exp2(log2_alpha), task.alpha_max);
        let now = (*light).now;
        let next = now - alpha * now;
        if next > task.light_min {
            rgb += alpha * now * pairs[k].rgb;
            (*light).left = next;
            (*light).reached = before + k + 1u;
        }
        (*light).now = next;
    }
    return rgb;
}

// Set `extent.x` to whether a pixel of the tile is not yet stopped.
fn look(light: f32, t: u32) {
    if light > task.light_min { atomicStore(&lit, 1u); }
    workgroupBarrier();
    if t == 0u { extent.x = atomicLoad(&lit); }
}

fn store(pixel: vec2<u32>, rgb: vec3<f32>) {
    let at = pixel.y * task.size.x + pixel.x;
    for (var c = 0u; c < 3u; c++) { image[3u * at + c] = rgb[c]; }
}

@compute @workgroup_size(16, 16)
fn draw(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let tile = block_of(group, groups);
    let corner = begin(tile, t);
    let span = workgroupUniformLoad(&extent);
    let pixel = corner + local.xy;
    let inside = all(pixel < task.size);
    let full = select(0.0, 1.0, inside);
    var light = Light(full, full, 0u);
    var bucket = PIXELS * (span.x / BUCKET + tile) + t;
    let bottom = bucket;
    for (var start = span.x; start < span.y; start += BUCKET) {
        let count = min(span.y - start, BUCKET);
        fetch(start, count, corner, t);
        let rgb = blend(count, start - span.x, local.xy, &light);
        behind[bucket] = vec4(rgb, light.left);
        bucket += PIXELS;
        look(light.now, t);
        if workgroupUniformLoad(&extent).x == 0u { break; }
    }
    var rgb = light.left * task.background.rgb;
    while bucket > bottom {
        bucket -= PIXELS;
        let own = behind[bucket];
        behind[bucket] = vec4(rgb, own.w);
        rgb += own.rgb;
    }
    if inside {
        store(pixel, rgb);
        last[pixel.y * task.size.x + pixel.x] = light.reached;
    }
}

@compute @workgroup_size(16, 16)
fn show(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let corner = begin(block_of(group, groups), t);
    let span = workgroupUniformLoad(&extent);
    let pixel = corner + local.xy;
    let inside = all(pixel < task.size);
    let full = select(0.0, 1.0, inside);
    var light = Light(full, full, 0u);
    var rgb = vec3(0.0);
    for (var start = span.x; start < span.y; start += BUCKET) {
        let count = min(span.y - start, BUCKET);
        fetch(start, count, corner, t);
        rgb += blend(count, start - span.x, local.xy, &light);
        look(light.now, t);
        if workgroupUniformLoad(&extent).x == 0u { break; }
    }
    if inside { store(pixel, rgb + light.left * task.background.rgb); }
}

var<workgroup> bucket_: vec3<u32>; // its tile, its first pair and their number
var<workgroup> pulls: array<vec4<f32>, 256>; // each pixel's gradient, and its light behind the pair last done
var<workgroup> hues: array<f32, 256>; // the colour behind it as if unoccluded, dotted with the gradient
var<workgroup> lasts: array<u32, 256>;
var<workgroup> deepest: atomic<u32>;
var<workgroup> seen: u32;

// The tile of a bucket, its first pair and their number.
fn bucket_at(number: u32) -> vec3<u32> {
    let tiles = tiles_across() * tiles_down();
    if number >= first_bucket(tiles) { return vec3(0u); }
    var low = 0u;
    var high = tiles;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if first_bucket(middle) <= number { low = middle; } else { high = middle; }
    }
    let start = first[low] + BUCKET * (number - first_bucket(low));
    let end = first[low + 1u];
    return vec3(low, start, min(end - min(start, end), BUCKET));
}

@compute @workgroup_size(32)
fn backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let number = block_of(group, groups);
    if t == 0u {
        bucket_ = bucket_at(number);
        atomicStore(&deepest, 0u);
    }
    let own = workgroupUniformLoad(&bucket_);
    if own.z == 0u { return; }
    let across = tiles_across();
    let corner = TILE * vec2(own.x % across, own.x / across);
    let nth = own.y - first[own.x] + t; // of the tile
    for (var p = t; p < PIXELS; p += BUCKET) {
        let pixel = corner + vec2(p % TILE, p / TILE);
        lasts[p] = 0u;
        if all(pixel < task.size) {
            let at = pixel.y * task.size.x + pixel.x;
            let found = behind[PIXELS * number + p];
            let pull = vec3(image[3u * at], image[3u * at + 1u], image[3u * at + 2u]);
            pulls[p] = vec4(pull, found.w);
            hues[p] = dot(found.rgb, pull) / found.w;
            lasts[p] = last[at];
            atomicMax(&deepest, last[at]);
        }
    }
    workgroupBarrier();
    if t == 0u { seen = atomicLoad(&deepest); }
    var sum: array<f32, 9>; // Σ h·(1, u, v, u², uv, v²), h = dL/d(ln α), and Σ w·(dR, dG, dB), w = αT
    if workgroupUniformLoad(&seen) > own.y - first[own.x] {
        var pair: Pair;
        if t < own.z { pair = pair_at(own.y + t, corner); }
        for (var tick = 0u; tick < PIXELS + BUCKET - 1u; tick++) {
            let p = tick + t - (BUCKET - 1u); // a huge number before the thread's turn
            if p < PIXELS && t < own.z && nth < lasts[min(p, PIXELS - 1u)] {
                let r = reach(pair, vec2(p % TILE, p / TILE));
                if r.z >= LOG2_ALPHA_MIN {
                    let raw = exp2(r.z);
                    let alpha = min(raw, task.alpha_max);
                    let pull = pulls[p];
                    let light = pull.w / (1.0 - alpha);
                    let w = alpha * light;
                    let gain = dot(pair.rgb, pull.rgb) - hues[p];
                    hues[p] += alpha * gain;
                    pulls[p].w = light;
                    // A clipped α does not depend on its arguments.
                    let h = select(0.0, w * gain, raw <= task.alpha_max);
                    sum[0] += h;
                    sum[1] += h * r.x;
                    sum[2] += h * r.y;
                    sum[3] += h * r.x * r.x;
                    sum[4] += h * r.x * r.y;
                    sum[5] += h * r.y * r.y;
                    for (var c = 0u; c < 3u; c++) { sum[6u + c] += w * pull[c]; }
                }
            }
            workgroupBarrier();
        }
    }
    if t < own.z { sums[places[own.y + t]] = sum; }
}
