// Shared by all kernels: a dispatch may have rows of groups, since a dimension holds at most 65 535.
const THREADS = 256u;  // of a group, but where a kernel says otherwise

fn group_index(group: vec3u, groups: vec3u) -> u32 { return group.y * groups.x + group.x; }

// By the bits: a compiler may take for granted that a float is finite.
fn is_finite(x: f32) -> bool { return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u; }
fn is_nan(x: f32) -> bool { return (bitcast<u32>(x) & 0x7fffffffu) > 0x7f800000u; }
