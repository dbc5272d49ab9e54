// The median depth: a workgroup takes a tile, a thread a pixel. It goes through the tile's splats, nearest first,
// until less than half the light is left. Pixels that nobody asks for start without any. A dispatch draws the
// view.count splats of each tile from the view.first-th on.

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> drawn: array<u32>;
@group(0) @binding(3) var<storage, read> bounds: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> light: array<f32>;
@group(0) @binding(5) var<storage, read_write> depth: array<f32>;

const ALPHA_MIN = 1.0 / 255.0;
const ALPHA_MAX = 0.99;

fn within(at: u32, span: u32) -> bool { return at >= (span & 0xffffu) && at < (span >> 16u); }

@compute @workgroup_size(16, 16)
fn draw(
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
    if left < 0.5 { return; }
    let range = bounds[tile];
    if view.first >= range.y - range.x { return; }
    let first = range.x + view.first;
    let end = first + min(view.count, range.y - first);
    for (var i = first; i < end; i++) {
        let s = splats[drawn[i]];
        if !within(pixel.x, s.columns) || !within(pixel.y, s.rows) { continue; }
        let dx = f32(pixel.x) + 0.5 - s.x;
        let dy = f32(pixel.y) + 0.5 - s.y;
        let power = 0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) + s.conic[1] * dx * dy;
        let alpha = min(s.opacity * exp(-power), ALPHA_MAX);
        if alpha < ALPHA_MIN || power < 0.0 { continue; }
        left *= 1.0 - alpha;
        if left < 0.5 {
            depth[at] = s.z;
            break;
        }
    }
    light[at] = left;
}
