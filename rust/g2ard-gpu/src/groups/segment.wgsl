// Where a group's members lie, and how many of them, which come first, are its own.

struct Group {
    first: u32,
    count: u32,
    own: u32,
}

// Both counts in one word.
fn group_of(segment: vec2<u32>) -> Group {
    return Group(segment.x, segment.y & 0xffffu, segment.y >> 16u);
}

