// Blends tiles of projected Gaussians, forward and back to front, up to four channels at a time; raster.cpp says what is
// computed. `//#native ` and `//#swap ` begin lines for adapters with and without atomic sums of floats.
const BATCH = 128u;   // Gaussians in workgroup memory
const PIXELS = 256u;  // of a tile
const RING = 32u;     // threads of blend_backward: a Gaussian each
const CHUNK = 8u;     // pixels of a step of blend_backward: RING * CHUNK = PIXELS
const MOMENTS = 6u;   // sums of v times 1, dx, u, dx^2, dx u, u^2

struct Call {
    background: vec4f,
    width: u32, height: u32, first_channel: u32, row: u32,  // row: numbers in a row of gradients
    count: u32,
    first_tile: u32, end_tile: u32,  // the tiles that are blended
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> channels: array<vec4f>;
@group(0) @binding(3) var<storage, read> ids: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(5) var<storage, read_write> image: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> endings_out: array<vec2u>;  // bits of the transmittance, last pair + 1
@group(0) @binding(7) var<storage, read> endings: array<vec2u>;
@group(0) @binding(8) var<storage, read> by_image: array<vec4f>;
@group(0) @binding(9) var<storage, read> by_alpha: array<f32>;
//#native @group(0) @binding(10) var<storage, read_write> gradients: array<atomic<f32>>;  // (N, row): moments, channels
//#swap @group(0) @binding(10) var<storage, read_write> gradients: array<atomic<u32>>;  // (N, row): moments, channels
@group(0) @binding(11) var<storage, read> moments: array<f32>;
@group(0) @binding(12) var<storage, read_write> geometry: array<f32>;

var<workgroup> place: array<vec4f, 128>;  // x, y, k, opacity
var<workgroup> shape: array<vec4f, 128>;  // of the exponent, in base 2: c, h, limit
var<workgroup> color: array<vec4f, 128>;
var<workgroup> going_any: atomic<u32>;
var<workgroup> uniform_word: u32;

// A thread blends four pixels of a column.
@compute @workgroup_size(64)
fn blend_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                 @builtin(local_invocation_index) thread: u32) {
    let across = (call.width + TILE - 1u) / TILE;
    let tile = min(call.first_tile + group_index(group, groups), call.end_tile - 1u);  // a group beyond the last tile repeats it
    let range = ranges[tile];
    let corner = vec2u(tile % across, tile / across) * TILE + vec2u(thread % TILE, thread / TILE * 4u);
    let x = f32(corner.x) + 0.5;
    let y = f32(corner.y) + vec4f(0.5, 1.5, 2.5, 3.5);
    let inside = vec4<bool>(corner.x < call.width) & (y < vec4f(f32(call.height)));
    var going = inside;
    var sums: array<vec4f, 4>;  // of each pixel
    var T = vec4f(1.0);
    var ended = vec4u(range.x);
    for (var start = range.x; start < range.y; start += BATCH) {
        if (thread == 0u) { atomicStore(&going_any, 0u); }
        workgroupBarrier();
        if (any(going)) { atomicOr(&going_any, 1u); }
        let n = min(BATCH, range.y - start);
        for (var i = thread; i < n; i += 64u) {
            let id = ids[start + i];
            let g = splats[id];
            place[i] = vec4f(g.x, g.y, g.k, g.opacity);
            shape[i] = vec4f(-LOG2E * g.c, -LOG2E * g.h, -LOG2E * g.limit, 0.0);
            color[i] = channels[id];
        }
        workgroupBarrier();
        if (thread == 0u) { uniform_word = atomicLoad(&going_any); }
        if (workgroupUniformLoad(&uniform_word) == 0u) { break; }
        for (var i = 0u; i < n; i++) {
            let p = place[i];
            let q = shape[i];
            let dx = p.x - x;
            let u = fma(vec4f(p.z), vec4f(dx), p.y - y);
            let exponent = fma(q.x * u, u, vec4f(q.y * dx * dx));
            let drawn = going & (exponent >= vec4f(q.z));
            if (any(drawn)) {
                let weight = min(p.w * exp2(exponent), vec4f(MAX_ALPHA)) * T;
                let after = T - weight;
                let stays = after > vec4f(MIN_TRANSMITTANCE);
                let adds = drawn & stays;
                going = going & (stays | !drawn);
                let used = select(vec4f(0.0), weight, adds);
                for (var k = 0u; k < 4u; k++) { sums[k] += used[k] * color[i]; }
                T = select(T, after, adds);
                ended = select(ended, vec4u(start + i + 1u), adds);
            }
        }
        workgroupBarrier();
    }
    for (var k = 0u; k < 4u; k++) {
        if (inside[k]) {
            let at = (corner.y + k) * call.width + corner.x;
            image[at] = sums[k] + T[k] * call.background;
            endings_out[at] = vec2u(bitcast<u32>(T[k]), ended[k]);
        }
    }
}

fn add_to(at: u32, value: f32) {
//#native     atomicAdd(&gradients[at], value);
//#swap     var old = atomicLoad(&gradients[at]);
//#swap     loop {
//#swap         let seen = atomicCompareExchangeWeak(&gradients[at], old, bitcast<u32>(bitcast<f32>(old) + value));
//#swap         if (seen.exchanged) { break; }
//#swap         old = seen.old_value;
//#swap     }
}

var<workgroup> tile_ended: atomic<u32>;
var<workgroup> state: array<vec2f, 256>;     // transmittance in front of what was visited; what the gradient meets there
var<workgroup> gradient: array<vec4f, 256>;  // by the pixel's channels
var<workgroup> pixel_ended: array<u32, 256>;

// Back to front from the final transmittance, T_i = T_(i+1) / (1 - alpha_i). Each thread takes one Gaussian over all
// pixels, a chunk a step, one step behind the thread before it: each pixel meets the Gaussians in their order.
@compute @workgroup_size(32)
fn blend_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                  @builtin(local_invocation_index) thread: u32) {
    let across = (call.width + TILE - 1u) / TILE;
    let tile = call.first_tile + group_index(group, groups);
    if (tile >= call.end_tile) { return; }
    let range = ranges[tile];
    let corner = vec2u(tile % across, tile / across) * TILE;
    if (thread == 0u) { atomicStore(&tile_ended, range.x); }
    workgroupBarrier();
    for (var p = thread; p < PIXELS; p += RING) {
        let pixel = corner + vec2u(p % TILE, p / TILE);
        var g = vec4f(0.0);
        var at_end = vec2f(1.0, 0.0);
        var ended = 0u;
        if (pixel.x < call.width && pixel.y < call.height) {
            let at = pixel.y * call.width + pixel.x;
            let T = bitcast<f32>(endings[at].x);
            ended = endings[at].y;
            g = by_image[at];
            at_end = vec2f(T, T * dot(g, call.background));
            if (call.first_channel == 0u) { at_end.y -= T * by_alpha[at]; }  // comes with the first channels only
            atomicMax(&tile_ended, ended);
        }
        gradient[p] = g;
        state[p] = at_end;
        pixel_ended[p] = ended;
    }
    workgroupBarrier();
    if (thread == 0u) { uniform_word = atomicLoad(&tile_ended); }
    let count = workgroupUniformLoad(&uniform_word) - range.x;
    let steps = (count + RING - 1u) / RING * RING + RING - 1u;
    if (count == 0u) { return; }
    var s: Splat;
    var c = vec4f(0.0);
    var pair = 0u;
    var id = 0u;
    var m: array<f32, 6>;
    var by_channels = vec4f(0.0);
    for (var step = 0u; step < steps; step++) {
        let own = step - thread;  // wraps to a huge number before the thread begins
        let rank = own / RING * RING + thread;
        if (step >= thread && rank < count) {
            if (own % RING == 0u) {
                pair = range.x + count - 1u - rank;
                id = ids[pair];
                s = splats[id];
                c = channels[id];
                m = array<f32, 6>();
                by_channels = vec4f(0.0);
            }
            for (var i = 0u; i < CHUNK; i++) {
                let p = own % RING * CHUNK + i;
                let dx = s.x - (f32(corner.x + p % TILE) + 0.5);
                let u = fma(s.k, dx, s.y - (f32(corner.y + p / TILE) + 0.5));
                let exponent = fma(-LOG2E * s.c * u, u, -LOG2E * s.h * dx * dx);
                if (pair >= pixel_ended[p] || exponent < -LOG2E * s.limit) { continue; }
                let unclamped = s.opacity * exp2(exponent);
                let alpha = min(unclamped, MAX_ALPHA);
                let inverse = 1.0 / (1.0 - alpha);
                let T = state[p].x * inverse;
                let behind = state[p].y;
                let along = dot(gradient[p], c);
                let weight = alpha * T;
                by_channels += weight * gradient[p];
                state[p] = vec2f(T, behind + weight * along);
                if (unclamped < MAX_ALPHA) {
                    let v = (T * along - behind * inverse) * unclamped;
                    m[0] += v;
                    m[1] += v * dx;
                    m[2] += v * u;
                    m[3] += v * dx * dx;
                    m[4] += v * u * dx;
                    m[5] += v * u * u;
                }
            }
            if (own % RING == RING - 1u) {
                let to = id * call.row;
                for (var k = 0u; k < MOMENTS; k++) { add_to(to + k, m[k]); }
                for (var k = 0u; k < 4u; k++) { add_to(to + MOMENTS + call.first_channel + k, by_channels[k]); }
            }
        }
        workgroupBarrier();
    }
}

// geometry (N, 6): gradients by means2d, conics and opacities from the moments, as in blend.cu.
@compute @workgroup_size(256)
fn turn_moments(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    let g = splats[i];
    let at = i * call.row;
    let v = moments[at]; let vx = moments[at + 1u]; let vu = moments[at + 2u];
    let vxx = moments[at + 3u]; let vxu = moments[at + 4u]; let vuu = moments[at + 5u];
    geometry[6u * i] = -2.0 * (g.c * g.k * vu + g.h * vx);
    geometry[6u * i + 1u] = -2.0 * g.c * vu;
    geometry[6u * i + 2u] = -0.5 * vxx;
    geometry[6u * i + 3u] = g.k * vxx - vxu;
    geometry[6u * i + 4u] = g.k * vxu - 0.5 * (vuu + g.k * g.k * vxx);
    var by_opacity = 0.0;
    if (g.opacity > 0.0) { by_opacity = v / g.opacity; }
    geometry[6u * i + 5u] = by_opacity;
}
