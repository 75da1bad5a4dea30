// The learned numbers of water, lamp, gains and background: what a step takes from them, and how it updates them; and the
// outcome of a step. One group of threads each. water/medium.py and the files of effects/ say what is computed.
const PIXEL_SUMS = 54u;     // as in photo.wgsl
const GAUSSIAN_SUMS = 34u;  // as in water.wgsl

// Places of `learned`, whose first `size` numbers are followed by their first and second moments.
const ATTENUATION = 0u;      // (3,) raw
const BACKSCATTER = 3u;      // (3,) raw
const BACKGROUND_SH = 6u;    // (9, 3)
const LOG_TAU = 33u;         // of the lamp
const RAW_VIGNETTING = 34u;  // (3,) of the vignetting
const RAW_BEAM = 37u;        // (14,) of the beam
const RAW_BEHIND = 51u;      // (3,) raw color behind the Gaussians
const EXPOSURES = 54u;       // (images, channels) log gains
const MOST_LOG_TAU = 12.0;
const OUTCOME = 8u;          // numbers of a step's outcome

// Bits of `flags`, as in gaussians.wgsl.
const LOSS = 32u;
const OVERFLOW = 64u;

struct Call {
    rates: vec4f, more_rates: vec4f,  // step sizes of Adam, in the order of `learned`; not updated where below 0
    root: f32, weight1: f32, weight2: f32, epsilon: f32,        // of Adam, as in adam.wgsl
    size: u32, image: u32, images: u32, channels: u32,          // of `learned`; the step's exposure, and how many there are
    centred: u32, same_beta: u32, mode: u32, row: u32,          // exposures have a mean of 0; beta_B is beta_D; bits of
                                                                // medium.wgsl; place of the outcome
    medium_range: f32, lamp_range: f32,                         // median ranges, scene units
    center_x: f32, center_y: f32, least: f32, most: f32,        // of the vignetting
    pixel_rows: u32, gaussian_rows: u32, squares: u32, bands: u32,
    most_beam: f32,                                             // most of the beam's log gain, 0 without a beam
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(2) var<storage, read_write> learned: array<f32>;
@group(0) @binding(3) var<storage, read_write> numbers_out: array<f32>;
@group(0) @binding(4) var<storage, read> pixel_sums: array<f32>;
@group(0) @binding(5) var<storage, read> gaussian_sums: array<f32>;
@group(0) @binding(6) var<storage, read> similarity: array<vec2f>;
@group(0) @binding(7) var<storage, read> pairs: array<vec2u>;  // of each band: how many there are, how many fit
@group(0) @binding(8) var<storage, read_write> outcomes: array<u32>;
@group(0) @binding(9) var<storage, read_write> flags: array<u32>;  // of the step; whether a step before it overflowed

var<workgroup> partial: array<f32, 256>;
var<workgroup> sums: array<f32, 88>;
var<workgroup> found: u32;

fn sigmoid(x: f32) -> f32 { return 1.0 / (1.0 + exp(-x)); }

// log(1 + exp(x)); the logarithm by the series of the inverse hyperbolic tangent: near 1, log() has few correct digits.
fn softplus(x: f32) -> f32 {
    let u = exp(-abs(x));
    let z = u / (2.0 + u);
    let q = z * z;
    let series = 1.0 + q * (1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * (1.0 / 9.0 + q / 11.0))));
    return max(x, 0.0) + 2.0 * z * series;
}

// The sum of all threads' values, for all of them.
fn total_of(value: f32, thread: u32) -> f32 {
    partial[thread] = value;
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) { partial[thread] += partial[thread + step]; }
    }
    workgroupBarrier();
    let total = partial[0];
    workgroupBarrier();
    return total;
}

// The numbers of a step, as medium.wgsl has them.
@compute @workgroup_size(256)
fn set_numbers(@builtin(local_invocation_index) thread: u32) {
    if (thread < 3u) {
        let beta_D = softplus(learned[ATTENUATION + thread]) / call.medium_range;
        numbers_out[BETA_D + thread] = beta_D;
        numbers_out[BETA_B + thread] =
            select(softplus(learned[BACKSCATTER + thread]) / call.medium_range, beta_D, call.same_beta == 1u);
        numbers_out[VIGNETTING + thread] = learned[RAW_VIGNETTING + thread];
        numbers_out[COLOR_BEHIND + thread] = sigmoid(learned[RAW_BEHIND + thread]);
    }
    if (thread < BEAM_TERMS) { numbers_out[BEAM + thread] = learned[RAW_BEAM + thread]; }
    if (thread < 27u) { numbers_out[BACKGROUND + thread] = learned[BACKGROUND_SH + thread]; }
    if (thread == 0u) {
        numbers_out[TAU] = exp(clamp(learned[LOG_TAU], -MOST_LOG_TAU, MOST_LOG_TAU));
        numbers_out[UNIT_RANGE] = call.lamp_range;
        numbers_out[CENTRE] = call.center_x;
        numbers_out[CENTRE + 1u] = call.center_y;
        numbers_out[BOUNDS] = call.least;
        numbers_out[BOUNDS + 1u] = call.most;
        numbers_out[BEAM + BEAM_TERMS] = call.most_beam;
    }
    for (var c = 0u; c < 3u; c++) {
        var log_gain = 0.0;
        if (call.channels > 0u) {
            let channel = min(c, call.channels - 1u);
            var sum = 0.0;
            for (var i = thread; i < call.images; i += THREADS) { sum += learned[EXPOSURES + call.channels * i + channel]; }
            let mean = total_of(sum, thread) / f32(call.images);
            log_gain = learned[EXPOSURES + call.channels * call.image + channel];
            if (call.centred == 1u) { log_gain -= mean; }
        }
        if (thread == 0u) { numbers_out[GAINS + c] = exp(log_gain); }
    }
}

// The gradient of the loss by a learned number.
fn gradient_of(place: u32) -> f32 {
    let value = learned[place];
    if (place < BACKGROUND_SH) {
        let c = place % 3u;
        var by = sums[PIXEL_SUMS + place];
        if (place < BACKSCATTER && call.same_beta == 1u) { by += sums[PIXEL_SUMS + BETA_B + c]; }
        return by * sigmoid(value) / call.medium_range;
    }
    if (place < LOG_TAU) {
        return sums[PIXEL_SUMS + place] + select(0.0, sums[26u + place - BACKGROUND_SH], (call.mode & OPEN) != 0u);
    }
    if (place == LOG_TAU) { return select(0.0, sums[PIXEL_SUMS + TAU] * exp(value), abs(value) <= MOST_LOG_TAU); }
    if (place < RAW_BEHIND) { return sums[6u + place - RAW_VIGNETTING]; }
    if (place < EXPOSURES) {
        let color = sigmoid(value);
        return sums[23u + place - RAW_BEHIND] * color * (1.0 - color);
    }
    let channel = (place - EXPOSURES) % call.channels;
    var by = sums[3u + channel];
    if (call.channels == 1u) { by += sums[4] + sums[5]; }
    let own = select(0.0, by, (place - EXPOSURES) / call.channels == call.image);
    return own - select(0.0, by / f32(call.images), call.centred == 1u);
}

fn rate_of(place: u32) -> f32 {
    if (place < BACKSCATTER) { return call.rates.x; }
    if (place < BACKGROUND_SH) { return call.rates.y; }
    if (place < LOG_TAU) { return call.rates.z; }
    if (place == LOG_TAU) { return call.rates.w; }
    if (place < RAW_BEAM) { return call.more_rates.x; }
    if (place < RAW_BEHIND) { return call.more_rates.y; }
    if (place < EXPOSURES) { return call.more_rates.z; }
    return call.more_rates.w;
}

// Sums, then the outcome: sums of |error|, error^2, what is left open and SSIM; flags; pairs in the longest list, and in
// all. Then Adam, where no flag is set. After a step that overflowed no step changes anything, so that the host can make all
// of them again in their order.
@compute @workgroup_size(256)
fn conclude(@builtin(local_invocation_index) thread: u32) {
    if (thread == 0u) { found = flags[0]; }
    workgroupBarrier();
    var sum = 0.0;
    if (thread < PIXEL_SUMS) {
        for (var row = 0u; row < call.pixel_rows; row++) { sum += pixel_sums[row * PIXEL_SUMS + thread]; }
    } else if (thread < PIXEL_SUMS + GAUSSIAN_SUMS) {
        let column = thread - PIXEL_SUMS;
        for (var row = 0u; row < call.gaussian_rows; row++) { sum += gaussian_sums[row * GAUSSIAN_SUMS + column]; }
    }
    if (thread < PIXEL_SUMS + GAUSSIAN_SUMS) { sums[thread] = sum; }
    let bad = total_of(select(0.0, 1.0, !is_finite(sum)), thread);
    var similar = 0.0;
    for (var i = thread; i < call.squares; i += THREADS) { similar += similarity[i].y; }
    similar = total_of(similar, thread);
    if (thread == 0u) {
        var longest = 0u;
        var all = 0u;
        var overflow = flags[1] != 0u;
        for (var i = 0u; i < call.bands; i++) {
            longest = max(longest, pairs[i].x);
            all += pairs[i].x;
            overflow = overflow || pairs[i].x > pairs[i].y;
        }
        found |= select(0u, LOSS, bad > 0.0 || !is_finite(similar)) | select(0u, OVERFLOW, overflow);
        flags[0] = found;
        flags[1] = found & OVERFLOW;
        let at = OUTCOME * call.row;
        for (var i = 0u; i < 3u; i++) { outcomes[at + i] = bitcast<u32>(sums[i]); }
        outcomes[at + 3u] = bitcast<u32>(similar);
        outcomes[at + 4u] = found;
        outcomes[at + 5u] = longest;
        outcomes[at + 6u] = all;
    }
    workgroupBarrier();
    if (found != 0u) { return; }
    for (var i = thread; i < call.size; i += THREADS) {
        let rate = rate_of(i);
        if (rate >= 0.0) {
            let old = Moved(learned[i], learned[call.size + i], learned[2u * call.size + i]);
            let moved = adam_of(old, gradient_of(i), rate, call.root, call.weight1, call.weight2, call.epsilon);
            learned[i] = moved.value;
            learned[call.size + i] = moved.mean;
            learned[2u * call.size + i] = moved.square;
        }
    }
}
