// One camera, and Gaussians as it sees them, by the formulas of g2ard_core::raster.

struct View {
    rotation: array<vec4<f32>, 3>, // rows; the fourth is what `eye` lacks of the camera's position
    eye: vec4<f32>,
    focal: vec2<f32>,
    center: vec2<f32>,
    limits: vec4<f32>, // of x/z: low, high; of y/z: low, high
    size: vec2<u32>, // of the image
    near: f32,
    count: u32, // rows, cells or splats there are
    first: u32, // of the pairs of splat and tile
    pairs: u32, // how many from there on
    all_pairs: u32,
    cell: f32, // edge of a cell
    tolerance: f32, // share of its depth that a cell may lie off the depths
    alpha_max: f32,
    light_min: f32, // a pixel ends before its light would fall to this
    zero: u32,
}

@group(0) @binding(0) var<uniform> view: View;

const DILATION = 0.3;
const TILE = 16u;

struct Splat {
    x: f32,
    y: f32,
    // α = opacity · 2^−(u² + v²), u = a·dx + b·dy, v = c·dy
    a: f32,
    b: f32,
    c: f32,
    opacity: f32,
    z: f32,
    columns: u32, // start in the low half, end in the high
    rows: u32,
    row: u32,
}

// Compilers may reorder sums, but not across this.
fn opaque(v: vec3<f32>) -> vec3<f32> {
    return bitcast<vec3<f32>>(bitcast<vec3<u32>>(v) ^ vec3(view.zero));
}

// Whether 0 ≤ x < most, by the bits: compilers may assume that no number is infinite or NaN.
fn bounded(x: f32, most: f32) -> bool { return bitcast<u32>(x) < bitcast<u32>(most); }

// About the camera first, so that a far origin costs no digits.
fn to_camera(p: vec3<f32>) -> vec3<f32> {
    let r = view.rotation;
    let d = opaque(p - view.eye.xyz) - vec3(r[0].w, r[1].w, r[2].w);
    return vec3(dot(r[0].xyz, d), dot(r[1].xyz, d), dot(r[2].xyz, d));
}

// The pixel a point falls into; no pixel has the last number.
fn pixel_of(t: vec3<f32>) -> u32 {
    if t.z <= view.near { return 0xffffffffu; }
    let at = view.focal * t.xy / t.z + view.center;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < f32(view.size.x) && at.y < f32(view.size.y)) {
        return 0xffffffffu;
    }
    let pixel = min(vec2<u32>(at), view.size - 1u);
    return pixel.y * view.size.x + pixel.x;
}

fn tiles_across() -> u32 { return (view.size.x + TILE - 1u) / TILE; }

fn tiles_down() -> u32 { return (view.size.y + TILE - 1u) / TILE; }

// First tile along an axis, and how many, of a packed span of pixels, which may be empty.
fn tile_span(span: u32) -> vec2<u32> {
    let first = (span & 0xffffu) / TILE;
    let end = ((span >> 16u) + TILE - 1u) / TILE;
    return vec2(first, end - min(first, end));
}

fn tile_count(s: Splat) -> u32 { return tile_span(s.columns).y * tile_span(s.rows).y; }
