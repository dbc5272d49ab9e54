// The tiles that a splat meets: those whose rectangle of pixel centres its ellipse at α = 1/255 touches.

struct Ellipse {
    center: vec2<f32>,
    // |(a·dx + b·dy, c·dy)|² ≤ level
    a: f32,
    b: f32,
    c: f32,
    level: f32,
    half: f32, // of its height
    right: f32, // dy of its rightmost point
    slack: f32, // of its width, against rounding
    rows: vec2<u32>, // of tiles: first, end
}

// Tiles whose pixel centres' interval [16t + 0.5, 16t + 15.5] meets [low, high]: first, end.
fn span(low: f32, high: f32, count: u32) -> vec2<u32> {
    let start = ceil((low + 0.5) / f32(TILE) - 1.0);
    let end = floor((high - 0.5) / f32(TILE) + 1.0);
    return vec2<u32>(clamp(vec2(start, end), vec2(0.0), vec2(f32(count))));
}

fn ellipse_of(s: Splat) -> Ellipse {
    var e: Ellipse;
    e.center = vec2(s.x, s.y);
    e.a = s.a;
    e.b = s.b;
    e.c = s.c;
    let reach = max(s.log2_opacity - LOG2_ALPHA_MIN, 0.0);
    e.level = reach * 1.0001 + 1e-4;
    let root = sqrt(s.b * s.b + s.c * s.c);
    let half = sqrt(reach) * vec2(root / (s.a * s.c), 1.0 / s.c);
    let slack = min(half, vec2(1e6)) * 1e-4 + 0.01;
    e.half = half.y + slack.y;
    e.right = -(half.x * s.a * s.b) / (root * root);
    e.slack = slack.x;
    e.rows = span(s.y - e.half, s.y + e.half, tiles_down());
    return e;
}

// The tiles of a row: first, end. A chord's end is a concave function of dy: its extreme over the row is at the ellipse's
// own, or nearest to it.
fn columns_of(e: Ellipse, row: u32) -> vec2<u32> {
    var top = f32(row * TILE) + 0.5 - e.center.y;
    let bottom = min(top + f32(TILE - 1u), e.half);
    top = min(max(top, -e.half), bottom);
    let dy = clamp(vec2(-e.right, e.right), vec2(top), vec2(bottom));
    let reach = sqrt(max(e.level - e.c * e.c * dy * dy, vec2(0.0))) / e.a + e.slack;
    let middle = e.center.x - e.b / e.a * dy;
    let found = span(middle.x - reach.x, middle.y + reach.y, tiles_across());
    return vec2(found.x, max(found.x, found.y));
}

fn tile_count(s: Splat) -> u32 {
    let e = ellipse_of(s);
    var count = 0u;
    for (var row = e.rows.x; row < e.rows.y; row++) {
        let columns = columns_of(e, row);
        count += columns.y - columns.x;
    }
    return count;
}
