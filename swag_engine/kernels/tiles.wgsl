// Which tiles each projected Gaussian meets, as in tiles.cu: packing, and the list of pairs of a Gaussian and a tile.
const ROW_MARGIN = 0.01;        // pixels; for rounding, since each pixel is tested again
const NOT_DRAWN = 0xffffffffu;  // key that sorts behind all others
const BLOCK = 1024u;            // counts that are summed together, as in sort.wgsl

struct Call {
    count: u32, width: u32, height: u32,
    room: u32,                     // pairs that the lists hold
    first_row: u32, end_row: u32,  // rows of tiles whose pairs are listed
    band: u32,                     // number of these rows' entry in `found`
    first: u32,                    // number of the first Gaussian
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> means2d: array<f32>;
@group(0) @binding(2) var<storage, read> conics: array<f32>;
@group(0) @binding(3) var<storage, read> opacities: array<f32>;
@group(0) @binding(4) var<storage, read> depths: array<f32>;
@group(0) @binding(5) var<storage, read> radii: array<f32>;
@group(0) @binding(6) var<storage, read_write> packed: array<Splat>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> ids: array<u32>;
@group(0) @binding(9) var<storage, read> splats: array<Splat>;
@group(0) @binding(10) var<storage, read> order: array<u32>;
@group(0) @binding(11) var<storage, read> sorted_keys: array<u32>;
@group(0) @binding(12) var<storage, read_write> counts: array<u32>;
@group(0) @binding(13) var<storage, read> starts: array<u32>;
@group(0) @binding(14) var<storage, read_write> ranges: array<u32>;
@group(0) @binding(15) var<storage, read> totals: array<u32>;           // the number of pairs, then that before each block
@group(0) @binding(16) var<storage, read_write> found: array<vec2u>;    // of each band: pairs there are, and that fit

// Packs the Gaussians and writes their depths as keys. The comparisons are written so that NaN is never drawn.
@compute @workgroup_size(256)
fn pack(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
        @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    ids[i] = call.first + i;
    keys[i] = NOT_DRAWN;
    let a = conics[3u * i]; let b = conics[3u * i + 1u]; let c = conics[3u * i + 2u];
    let bb = b * b;
    let det = fma(a, c, -bb) + fma(-b, b, bb);  // with the rounding of b^2 put right (Kahan) where fma is one operation
    let opacity = opacities[i];
    if (!(radii[i] > 0.0 && depths[i] > 0.0 && opacity > 0.0 && a > 0.0 && c > 0.0 && det > 0.0)) { return; }
    var g: Splat;
    g.x = means2d[2u * i];
    g.y = means2d[2u * i + 1u];
    g.opacity = opacity;
    g.limit = log(opacity) + LOG255;
    if (!(g.limit > 0.0 && g.limit < 64.0)) { return; }
    g.k = b / c;
    g.c = 0.5 * c;
    g.h = 0.5 * det / c;
    g.half_width = sqrt(2.0 * g.limit * c / det);
    g.half_height = sqrt(2.0 * g.limit * a / det);
    g.top = -b / a * g.half_height;
    let finite = g.half_width < 1e9 && g.half_height < 1e9 && g.h > 0.0 && g.c < 1e9;
    let on_screen = g.x + g.half_width > 0.0 && g.x - g.half_width < f32(call.width) && g.y + g.half_height > 0.0
        && g.y - g.half_height < f32(call.height);
    packed[i] = g;
    if (finite && on_screen) { keys[i] = bitcast<u32>(depths[i]); }
}

// The first and last column of tiles that the ellipse may meet.
fn tile_columns(g: Splat) -> vec2i {
    let first = i32(max(0.0, g.x - g.half_width - 0.51)) / i32(TILE);
    return vec2i(first, i32(min(f32(call.width) - 1.0, g.x + g.half_width - 0.49)) / i32(TILE));
}

// The first and last row of tiles in which the ellipse may meet pixel centres of a column; last < first where none.
fn tile_rows(g: Splat, column: i32) -> vec2i {
    let from_center = f32(column) * f32(TILE) + 0.5 - g.x;
    let across = min(f32(TILE), f32(call.width) - f32(column) * f32(TILE)) - 1.0;
    let left = max(from_center, -g.half_width);
    let right = min(from_center + across, g.half_width);
    if (!(left <= right)) { return vec2i(0, -1); }
    let reach_left = sqrt(max((g.limit - g.h * left * left) / g.c, 0.0));
    let reach_right = sqrt(max((g.limit - g.h * right * right) / g.c, 0.0));
    var low = min(-g.k * left - reach_left, -g.k * right - reach_right);
    var high = max(-g.k * left + reach_left, -g.k * right + reach_right);
    if (left <= g.top && g.top <= right) { high = g.half_height; }
    if (left <= -g.top && -g.top <= right) { low = -g.half_height; }
    low = max(0.0, ceil(g.y + low - ROW_MARGIN - 0.5));
    high = min(f32(call.height) - 1.0, floor(g.y + high + ROW_MARGIN - 0.5));
    if (!(low <= high)) { return vec2i(0, -1); }
    let rows = vec2i(i32(low), i32(high)) / i32(TILE);
    return vec2i(max(rows.x, i32(call.first_row)), min(rows.y, i32(call.end_row) - 1));
}

// How many tiles the Gaussian of each rank of the depth order meets.
@compute @workgroup_size(256)
fn count_tiles(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
               @builtin(local_invocation_index) thread: u32) {
    let rank = group_index(group, groups) * THREADS + thread;
    if (rank >= call.count) { return; }
    var count = 0u;
    if (sorted_keys[rank] != NOT_DRAWN) {
        let g = splats[order[rank]];
        let columns = tile_columns(g);
        for (var column = columns.x; column <= columns.y; column++) {
            let rows = tile_rows(g, column);
            count += u32(max(0, rows.y - rows.x + 1));
        }
    }
    counts[rank] = count;
}

// Where the pairs of a rank begin.
fn start_of(rank: u32) -> u32 { return starts[rank] + totals[rank / BLOCK + 1u]; }

// Writes the pairs of each rank, the tile as key and the Gaussian, and fills what is left of the lists, so that they can
// be sorted without knowing how many pairs there are.
@compute @workgroup_size(256)
fn fill_tiles(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
              @builtin(local_invocation_index) thread: u32) {
    let rank = group_index(group, groups) * THREADS + thread;  // and a place in the lists
    if (rank == 0u) { found[call.band] = vec2u(totals[0], call.room); }
    if (rank >= totals[0] && rank < call.room) {
        keys[rank] = NOT_DRAWN;
        ids[rank] = 0u;
    }
    if (rank >= call.count) { return; }
    var at = start_of(rank);
    var end = totals[0];
    if (rank + 1u < call.count) { end = start_of(rank + 1u); }
    end = min(end, call.room);
    if (at >= end) { return; }
    let i = order[rank];
    let g = splats[i];
    let columns = tile_columns(g);
    let across = (call.width + TILE - 1u) / TILE;
    for (var column = columns.x; column <= columns.y; column++) {
        let rows = tile_rows(g, column);
        for (var row = rows.x; row <= rows.y && at < end; row++) {
            keys[at] = u32(row) * across + u32(column);
            ids[at] = i;
            at++;
        }
    }
    for (; at < end; at++) {  // counted in code that rounded otherwise
        keys[at] = NOT_DRAWN;
        ids[at] = i;
    }
}

// Where the pairs of each tile begin and end; ranges (tiles, 2) are 0 before.
@compute @workgroup_size(256)
fn find_ranges(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
               @builtin(local_invocation_index) thread: u32) {
    let at = group_index(group, groups) * THREADS + thread;
    if (at >= call.room) { return; }
    let tile = sorted_keys[at];
    if (tile == NOT_DRAWN) { return; }
    if (at == 0u || sorted_keys[at - 1u] != tile) { ranges[2u * tile] = at; }
    if (at + 1u == call.room || sorted_keys[at + 1u] != tile) { ranges[2u * tile + 1u] = at + 1u; }
}
