// Stands before every kernel: dispatches go on in rows, for one axis is too short for the largest.

fn block_of(group: vec3<u32>, groups: vec3<u32>) -> u32 { return group.y * groups.x + group.x; }

// Of workgroups of `size` threads in a line.
fn thread_of(id: vec3<u32>, groups: vec3<u32>, size: u32) -> u32 { return id.y * groups.x * size + id.x; }

