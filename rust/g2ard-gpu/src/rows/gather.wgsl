// Members of groups, in the order of their groups: a thread takes one, and copies a part of its row if this piece of the
// rows holds it.

struct Piece {
    first: u32, // the number of its first row
    count: u32,
    members: u32, // how many there are
    stride: u32, // words of a row
    start: u32, // the part's first word
    words: u32, // and how many it has
}

@group(0) @binding(0) var<uniform> piece: Piece;
@group(0) @binding(1) var<storage, read> rows: array<u32>;
@group(0) @binding(2) var<storage, read> numbers: array<u32>;
@group(0) @binding(3) var<storage, read_write> members: array<u32>;

@compute @workgroup_size(64)
fn gather(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = thread_of(id, groups, 64u);
    if i >= piece.members { return; }
    let at = numbers[i] - piece.first; // of rows before it, too large a number
    if at >= piece.count { return; }
    for (var k = 0u; k < piece.words; k++) {
        members[piece.words * i + k] = rows[piece.stride * at + piece.start + k];
    }
}
