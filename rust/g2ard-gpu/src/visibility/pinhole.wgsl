// One camera, and Gaussians as it sees them: g2ard_core::select::Pinhole, step by step.

struct View {
    rotation: array<vec4<f32>, 3>, // rows; the fourth is the translation
    focal: vec2<f32>,
    center: vec2<f32>,
    limits: vec4<f32>, // of x/z: low, high; of y/z: low, high
    size: vec2<u32>, // of the image
    near: f32,
    count: u32, // rows or cells there are
    first: u32, // of this piece's rows among all
    start: u32, // range of depths, as bits: start … end − 1
    end: u32,
    cell: f32, // edge of a cell
    tolerance: f32, // share of its depth that a cell may lie off the depths
}

@group(0) @binding(0) var<uniform> view: View;

const DILATION = 0.3;
const TILE = 16u;

struct Splat {
    x: f32,
    y: f32,
    conic: array<f32, 3>,
    opacity: f32,
    z: f32,
    columns: u32, // from in the low half, to in the high
    rows: u32,
}

fn to_camera(p: vec3<f32>) -> vec3<f32> {
    var t: vec3<f32>;
    for (var r = 0; r < 3; r++) {
        let a = view.rotation[r];
        t[r] = a.x * p.x + a.y * p.y + a.z * p.z + a.w;
    }
    return t;
}

// The pixel a point falls into; no pixel has the last number.
fn pixel_of(t: vec3<f32>) -> u32 {
    if t.z <= view.near { return 0xffffffffu; }
    let at = view.focal * t.xy / t.z + view.center;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < f32(view.size.x) && at.y < f32(view.size.y)) {
        return 0xffffffffu;
    }
    return u32(at.y) * view.size.x + u32(at.x);
}

fn tiles_across() -> u32 { return (view.size.x + TILE - 1u) / TILE; }

// First tile along an axis, and how many, of a packed span of pixels.
fn tile_span(span: u32) -> vec2<u32> {
    let first = (span & 0xffffu) / TILE;
    return vec2(first, ((span >> 16u) - 1u) / TILE + 1u - first);
}

fn tile_count(s: Splat) -> u32 { return tile_span(s.columns).y * tile_span(s.rows).y; }
