// Where a group's members lie, and how many of them, which come first, are its own.

struct Group {
    first: u32,
    count: u32,
    own: u32,
}

@group(0) @binding(0) var<uniform> groups: vec4<u32>; // how many; a constant; the exponent of the frame's unit; 0
@group(0) @binding(1) var<storage, read> members: array<Member>;
@group(0) @binding(2) var<storage, read> segments: array<vec2<u32>>;

// Both counts in one word.
fn group_of(segment: vec2<u32>) -> Group {
    return Group(segment.x, segment.y & 0xffffu, segment.y >> 16u);
}

fn word(m: Member, k: i32) -> vec2<u32> { return vec2(m.mean[2 * k], m.mean[2 * k + 1]); }

// A member's mean less that of another, in the frame's unit times 2^-e.
fn offset(i: u32, base: u32, e: i32) -> array<Two, 3> {
    let a = members[i];
    let b = members[base];
    return array<Two, 3>(
        scaled(difference(word(a, 0), word(b, 0)), -e),
        scaled(difference(word(a, 1), word(b, 1)), -e),
        scaled(difference(word(a, 2), word(b, 2)), -e),
    );
}

// Bits of the largest coordinate of such a difference.
fn extent(i: u32, base: u32) -> i32 {
    let a = members[i];
    let b = members[base];
    let x = bits(difference(word(a, 0), word(b, 0)).size);
    let y = bits(difference(word(a, 1), word(b, 1)).size);
    return max(max(x, y), bits(difference(word(a, 2), word(b, 2)).size));
}
