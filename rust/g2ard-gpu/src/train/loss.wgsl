// (1 − λ)·L1 + λ·(1 − SSIM) and its gradient, as g2ard_core::ssim. `weigh`: each pixel's factor, for a mask. `compare`: a
// workgroup takes one channel of a tile, and leaves the derivatives by the blurred moments. `total`: one workgroup sums the
// loss. `gradient`: the derivatives, blurred back.

@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read> mask: array<u32>; // a byte per pixel
@group(0) @binding(4) var<storage, read_write> factors: array<f32>;
@group(0) @binding(5) var<storage, read_write> slopes: array<array<f32, 3>>; // per value of the image
@group(0) @binding(6) var<storage, read_write> parts: array<vec2<f32>>; // Σ|e| and Σ(1 − SSIM)
@group(0) @binding(7) var<storage, read_write> state: array<u32>;
@group(0) @binding(8) var<storage, read_write> pull: array<f32>;

const REACH = 5u;
const SIDE = 26u; // of a tile with the window's reach around it
const C1 = 1e-4;
const C2 = 9e-4;

fn weight(offset: u32) -> f32 {
    var weights = array(0.00102838, 0.007598758, 0.036000773, 0.10936069, 0.21300554, 0.26601172);
    return weights[min(offset, 10u - offset)];
}

fn counts(at: u32) -> bool {
    return task.masked == 0u || ((mask[at / 4u] >> (8u * (at % 4u))) & 255u) != 0u;
}

// The window's weights on pixels that count sum to less than 1 within a mask, and are divided by their sum.
@compute @workgroup_size(64)
fn weigh(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let at = thread_of(id, groups, 64u);
    if at >= task.size.x * task.size.y { return; }
    factors[at] = 1.0;
    if task.masked == 0u { return; }
    var sum = 0.0;
    let x = at % task.size.x;
    let y = at / task.size.x;
    for (var j = 0u; j <= 2u * REACH; j++) {
        let row = y + j - REACH; // a huge number above the image
        if row >= task.size.y { continue; }
        var along = 0.0;
        for (var i = 0u; i <= 2u * REACH; i++) {
            let column = x + i - REACH;
            if column < task.size.x && counts(row * task.size.x + column) { along += weight(i); }
        }
        sum += weight(j) * along;
    }
    factors[at] = select(0.0, 1.0 / sum, counts(at));
}

var<workgroup> pictures: array<vec2<f32>, 676>;
var<workgroup> blurred: array<vec4<f32>, 416>; // SIDE rows of the tile's columns
var<workgroup> losses: array<vec2<f32>, 256>;

struct Place {
    channel: u32,
    corner: vec2<u32>,
}

fn place_of(block: u32) -> Place {
    let tile = block / 3u;
    return Place(block % 3u, TILE * vec2(tile % tiles_across(), tile / tiles_across()));
}

// Image and target; 0 outside the image and the mask.
fn pictures_at(pixel: vec2<u32>, channel: u32) -> vec2<f32> {
    if any(pixel >= task.size) { return vec2(0.0); }
    let at = pixel.y * task.size.x + pixel.x;
    if !counts(at) { return vec2(0.0); }
    return vec2(image[3u * at + channel], wanted[3u * at + channel]);
}

// 1 − SSIM, and dSSIM by ⟨x⟩ (at a fixed target, so ⟨e⟩ too), ⟨x² + y²⟩ and ⟨e²⟩, from the blurred x, e, x² + y² and e².
fn derivatives_of(m: vec4<f32>) -> vec4<f32> {
    let x = m.x;
    let d = m.y;
    let y = x - d;
    let power = x * x + y * y;
    let r_p = 1.0 / (power + C1);
    let variance = m.z - power;
    let r_q = 1.0 / (max(variance, 0.0) + C2);
    let difference = m.w - d * d;
    let ratio = max(difference, 0.0) * r_q;
    let d_p = d * r_p;
    let luminance = 1.0 - d * d_p;
    let contrast = 1.0 - ratio;
    // Where rounding made a variance negative it is held at 0 and passes no gradient.
    let on_variance = select(0.0, ratio * r_q * luminance, variance > 0.0);
    let on_difference = select(0.0, r_q * luminance, difference >= 0.0);
    let on_mean = 2.0 * (contrast * (x * d_p * d_p - d_p) + d * on_difference - x * on_variance);
    return vec4(d * d_p + ratio - d * d_p * ratio, on_mean, on_variance, -on_difference);
}

@compute @workgroup_size(16, 16)
fn compare(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let block = block_of(group, groups);
    let place = place_of(block);
    for (var i = t; i < SIDE * SIDE; i += PIXELS) {
        pictures[i] = pictures_at(place.corner + vec2(i % SIDE, i / SIDE) - REACH, place.channel);
    }
    workgroupBarrier();
    for (var i = t; i < SIDE * TILE; i += PIXELS) {
        var sum = vec4(0.0);
        for (var k = 0u; k <= 2u * REACH; k++) {
            let p = pictures[i / TILE * SIDE + i % TILE + k];
            let e = p.x - p.y;
            sum += weight(k) * vec4(p.x, e, p.x * p.x + p.y * p.y, e * e);
        }
        blurred[i] = sum;
    }
    workgroupBarrier();
    var means = vec4(0.0);
    for (var k = 0u; k <= 2u * REACH; k++) { means += weight(k) * blurred[TILE * k + t]; }
    let pixel = place.corner + local.xy;
    losses[t] = vec2(0.0);
    if all(pixel < task.size) {
        let at = pixel.y * task.size.x + pixel.x;
        let found = derivatives_of(means * factors[at]);
        let slope = found.yzw * factors[at];
        slopes[3u * at + place.channel] = array(slope.x, slope.y, slope.z);
        let p = pictures[(local.y + REACH) * SIDE + local.x + REACH];
        losses[t] = vec2(abs(p.x - p.y), found.x);
    }
    sum_losses(t);
    if t == 0u && block < arrayLength(&parts) { parts[block] = losses[0]; }
}

// Leave the sum of `losses` in the first.
fn sum_losses(t: u32) {
    workgroupBarrier();
    for (var reach = PIXELS / 2u; reach > 0u; reach /= 2u) {
        if t < reach { losses[t] += losses[t + reach]; }
        workgroupBarrier();
    }
}

@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) t: u32) {
    var sum = vec2(0.0);
    for (var i = t; i < 3u * tiles_across() * tiles_down(); i += PIXELS) { sum += parts[i]; }
    losses[t] = sum;
    sum_losses(t);
    if t != 0u { return; }
    let means = losses[0] / task.values;
    let loss = (1.0 - task.ssim_weight) * means.x + task.ssim_weight * means.y;
    state[LOSS] = bitcast<u32>(loss);
    state[FACTOR] = bitcast<u32>(select(1.0, task.relative / max(loss, task.least_loss), task.relative > 0.0));
}

// Separate numbers, because a vec3 takes the room of four.
var<workgroup> around: array<array<f32, 3>, 676>;
var<workgroup> across: array<array<f32, 3>, 416>;

@compute @workgroup_size(16, 16)
fn gradient(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) t: u32,
) {
    let place = place_of(block_of(group, groups));
    for (var i = t; i < SIDE * SIDE; i += PIXELS) {
        let pixel = place.corner + vec2(i % SIDE, i / SIDE) - REACH;
        around[i] = array(0.0, 0.0, 0.0);
        if all(pixel < task.size) { around[i] = slopes[3u * (pixel.y * task.size.x + pixel.x) + place.channel]; }
    }
    workgroupBarrier();
    for (var i = t; i < SIDE * TILE; i += PIXELS) {
        var sum = vec3(0.0);
        for (var k = 0u; k <= 2u * REACH; k++) {
            let s = around[i / TILE * SIDE + i % TILE + k];
            sum += weight(k) * vec3(s[0], s[1], s[2]);
        }
        across[i] = array(sum.x, sum.y, sum.z);
    }
    workgroupBarrier();
    var b = vec3(0.0);
    for (var k = 0u; k <= 2u * REACH; k++) {
        let s = across[TILE * k + t];
        b += weight(k) * vec3(s[0], s[1], s[2]);
    }
    let pixel = place.corner + local.xy;
    if any(pixel >= task.size) { return; }
    let at = pixel.y * task.size.x + pixel.x;
    let p = pictures_at(pixel, place.channel);
    let e = p.x - p.y;
    let slope = b.x + 2.0 * (p.x * b.y + e * b.z);
    let found = ((1.0 - task.ssim_weight) * sign(e) - task.ssim_weight * slope) / task.values;
    pull[3u * at + place.channel] = select(0.0, found, factors[at] > 0.0) * bitcast<f32>(state[FACTOR]);
}
