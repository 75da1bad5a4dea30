// From the parameters of Gaussians to what the other kernels take, and back, as in gaussians.cpp; and what densification
// goes by.

// Bits of `flags`: whose gradient is not finite; effects.wgsl has others.
const MEANS = 1u;
const QUATS = 2u;
const LOG_SCALES = 4u;
const OPACITY_LOGITS = 8u;

struct Call {
    centre: vec4f,            // of the camera, scene units
    count: u32, first: u32,   // number of Gaussians, and of those before
    seed: u32, dropout: f32,  // random numbers of the iteration; the fraction of the Gaussians that is dropped
    least: f32, most: f32,    // of the logs of scales
    farthest: f32,            // component of an offset, scene units
    geometry: u32,            // whether means, quats and scales have gradients
    half_width: f32,          // of the image, pixels
    bit: u32,                 // of `flags`, in find_not_finite
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> log_scales: array<f32>;
@group(0) @binding(3) var<storage, read> logits: array<f32>;
@group(0) @binding(4) var<storage, read_write> scales: array<f32>;
@group(0) @binding(5) var<storage, read_write> opacities: array<f32>;
@group(0) @binding(6) var<storage, read_write> offsets: array<f32>;
@group(0) @binding(7) var<storage, read_write> directions: array<f32>;
@group(0) @binding(8) var<storage, read> geometry: array<f32>;
@group(0) @binding(9) var<storage, read> by_means: array<f32>;
@group(0) @binding(10) var<storage, read> by_quats: array<f32>;
@group(0) @binding(11) var<storage, read_write> by_log_scales: array<f32>;  // by scales before
@group(0) @binding(12) var<storage, read_write> by_logits: array<f32>;
@group(0) @binding(13) var<storage, read_write> flags: array<atomic<u32>>;
@group(0) @binding(14) var<storage, read> radii: array<f32>;
@group(0) @binding(15) var<storage, read_write> statistics: array<vec2f>;
@group(0) @binding(16) var<storage, read> values: array<f32>;

// The factor of an opacity: 0 for Gaussians that are dropped (random numbers: PCG, Jarzynski and Olano 2020).
fn factor_of(i: u32) -> f32 {
    if (call.dropout == 0.0) { return 1.0; }
    let state = ((call.first + i) ^ call.seed) * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    let random = f32(((word >> 22u) ^ word) >> 8u) / 16777216.0;
    return select(0.0, 1.0 / (1.0 - call.dropout), random >= call.dropout);
}

fn sigmoid(x: f32) -> f32 { return 1.0 / (1.0 + exp(-x)); }

@compute @workgroup_size(256)
fn activate(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
            @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    var offset: vec3f;
    for (var k = 0u; k < 3u; k++) {
        let at = 3u * i + k;
        let size = log_scales[at];
        scales[at] = select(size, exp(clamp(size, call.least, call.most)), is_finite(size));  // what is not finite stays
        offset[k] = means[at] - call.centre[k];
        offsets[at] = select(offset[k], clamp(offset[k], -call.farthest, call.farthest), is_finite(offset[k]));
    }
    let direction = offset / max(length(offset), 1e-12);
    for (var k = 0u; k < 3u; k++) { directions[3u * i + k] = direction[k]; }
    let factor = factor_of(i);
    opacities[i] = select(min(sigmoid(logits[i]) * factor, 1.0), sigmoid(logits[i]), factor == 1.0);
}

fn note(bit: u32, bad: bool) {
    if (bad) { atomicOr(&flags[0], bit); }
}

@compute @workgroup_size(256)
fn activate_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                     @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    if (call.geometry == 1u) {
        for (var k = 0u; k < 3u; k++) {
            let at = 3u * i + k;
            let size = log_scales[at];
            let inside = is_finite(size) && size >= call.least && size <= call.most;
            let by = select(0.0, by_log_scales[at] * exp(size), inside);
            by_log_scales[at] = by;
            note(LOG_SCALES, !is_finite(by));
            note(MEANS, !is_finite(by_means[at]));
        }
        for (var k = 0u; k < 4u; k++) { note(QUATS, !is_finite(by_quats[4u * i + k])); }
    }
    let own = sigmoid(logits[i]);
    let factor = factor_of(i);
    let kept = select(factor, 0.0, own * factor > 1.0);
    let by = geometry[6u * i + 5u] * kept * own * (1.0 - own);
    by_logits[i] = by;
    note(OPACITY_LOGITS, !is_finite(by) || !is_finite(own));
}

// Adds one view to what densification goes by: length of the gradient on screen per half image width, and views.
@compute @workgroup_size(256)
fn count_views(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
               @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count || atomicLoad(&flags[0]) != 0u) { return; }
    let by_center = vec2f(geometry[6u * i], geometry[6u * i + 1u]);
    statistics[i] += vec2f(length(by_center) * call.half_width, select(0.0, 1.0, radii[i] > 0.0));
}

// Sets a bit of `flags` where one of `count` numbers is not finite.
@compute @workgroup_size(256)
fn find_not_finite(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                   @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i < call.count) { note(call.bit, !is_finite(values[i])); }
}
