// What all kernels of a step share: its constants, and Gaussians on the screen.

struct Step {
    rotation: array<vec4<f32>, 3>, // camera_from_world, row by row, the translation last
    rotation_rest: array<vec4<f32>, 3>, // what f32 lacks of it
    eye: vec4<f32>,
    eye_rest: vec4<f32>,
    focal: vec4<f32>, // of x and y, then what f32 lacks of them
    center: vec4<f32>,
    limits: vec4<f32>, // of x/z: low, high; of y/z: low, high
    background: vec4<f32>,
    size: vec2<u32>, // of the image
    near: f32,
    alpha_max: f32,
    light_min: f32, // a pixel ends before its light would fall to this
    antialiased: u32,
    rows: u32,
    coeffs: u32, // of spherical harmonics, per channel
    capacity: u32, // pairs of splat and tile that there is room for
    most_in_tile: u32, // pairs of a tile that can be drawn
    masked: u32,
    values: f32, // of the image that count
    ssim_weight: f32,
    relative: f32, // a loss, or 0
    least_loss: f32,
    zero: u32,
    // Adam's rates; `reach` is 0 without a limit.
    means: f32,
    quats: f32,
    log_scales: f32,
    logits: f32,
    sh0: f32,
    sh_n: f32,
    reach: f32,
    finest: f32,
    // Weights of the regularisers' terms, per Gaussian.
    anchor: f32,
    thickness: f32,
    rank: f32,
    rank_offset: f32,
    momentum: f32, // Adam's β₁
}

@group(0) @binding(0) var<uniform> task: Step;

const TILE = 16u;
const BUCKET = 32u; // pairs of a tile that the backward pass takes together
const PIXELS = 256u; // of a tile
const DILATION = 0.3;
const HALF_LOG2_E = 0.72134752;
const LOG2_ALPHA_MIN = -7.9943534; // 1/255

// Words of `state`.
const TOTAL = 0u; // pairs
const FAILED = 1u; // 1 if there are too many pairs, 2 if a tile has
const UPDATED = 2u;
const SKIPPED = 3u;
const LOSS = 4u;
const FACTOR = 5u; // of the loss's gradient

struct Splat {
    x: f32,
    x_rest: f32,
    y: f32,
    y_rest: f32,
    // log2 α = log2_opacity − (u² + v²), u = a·dx + b·dy, v = c·dy
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    rgb: array<f32, 3>,
    tiles: u32,
    place: u32, // of its first pair, nearer splats' before it
}

fn tiles_across() -> u32 { return (task.size.x + TILE - 1u) / TILE; }

fn tiles_down() -> u32 { return (task.size.y + TILE - 1u) / TILE; }

// Whether 0 ≤ x < most, by the bits: compilers may assume that no number is infinite or NaN.
fn bounded(x: f32, most: f32) -> bool { return bitcast<u32>(x) < bitcast<u32>(most); }
