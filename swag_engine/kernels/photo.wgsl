// From a blended image to the photo that a camera would take of it, its differences from a training image, and back;
// photo.cpp says what is computed. A training image has a word a pixel: red, green, blue, and 0 where it is not valid, 255
// where it surely shows a surface, or 1.
const SUMS = 54u;  // |error|, error^2, what is left open of surfaces; gradients by the log gains (3), the coefficients
                   // of vignetting (3) and beam (14), the background (3) and the background light (27); one to spare

struct Call {
    row0: vec4f, row1: vec4f, row2: vec4f,  // rotation, world to camera
    intrinsics: vec4f,                      // fx, fy, cx, cy, pixels
    width: u32, height: u32, degree: u32, mode: u32,
    absolute: f32, square: f32, open: f32,  // factors of the gradient: of the error's sign, of the error, of open surface
    least: f32, most: f32,                  // differences from open water that are none, and that show a surface
    closed: f32,                            // part of what is behind a surface that may be seen
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(2) var<storage, read> blended: array<vec4f>;
@group(0) @binding(3) var<storage, read> ended: array<vec2u>;  // as `endings` of blend.wgsl
@group(0) @binding(4) var<storage, read> wanted: array<u32>;
@group(0) @binding(5) var<storage, read_write> photo: array<f32>;
@group(0) @binding(6) var<storage, read_write> aim: array<f32>;
@group(0) @binding(7) var<storage, read> by_photo: array<f32>;
@group(0) @binding(8) var<storage, read_write> by_blended: array<vec4f>;
@group(0) @binding(9) var<storage, read_write> by_transparent: array<f32>;
@group(0) @binding(10) var<storage, read_write> pixel_sums: array<f32>;

var<workgroup> partial: array<f32, 256>;

// One pixel as it is seen, with what the backward pass needs again.
struct Seen {
    valid: bool,
    surface: bool,
    T: f32,
    wanted: vec3f, color: vec3f,     // color: before any gain
    light: vec3f, slope: vec3f,      // after the gain; of the photo by the color
    photo: vec3f,
    behind: vec3f, B: vec3f,         // what is behind the Gaussians as display values; the light of open water
    squared: f32, polynomial: f32, vignetting: f32,
    place: vec2f, log_beam: f32,     // from the middle of the image, over half of its diagonal
}

// The powers of x and y in a term of the beam, in the order of its coefficients: x, y, x^2, xy, y^2, x^3 and so on.
fn beam_term(place: vec2f, term: u32) -> f32 {
    var power = 1u;
    var j = term;
    while (j > power) {
        j -= power + 1u;
        power++;
    }
    var value = 1.0;
    for (var k = 0u; k < power; k++) { value *= select(place.x, place.y, k < j); }
    return value;
}

fn direction_of(x: u32, y: u32) -> vec3f {
    let place = (vec2f(f32(x), f32(y)) + 0.5 - call.intrinsics.zw) / call.intrinsics.xy;
    return normalize(place.x * call.row0.xyz + place.y * call.row1.xyz + call.row2.xyz);
}

fn pixel_seen(at: u32, basis: ptr<function, array<f32, 16>>) -> Seen {
    var s: Seen;
    let word = wanted[at];
    s.valid = (word >> 24u) != 0u;
    s.surface = (word >> 24u) == 255u;
    s.wanted = vec3f(f32(word & 255u), f32((word >> 8u) & 255u), f32((word >> 16u) & 255u)) / 255.0;
    s.T = bitcast<f32>(ended[at].x);
    s.color = blended[at].xyz;
    let x = at % call.width;
    let y = at / call.width;
    if ((call.mode & OPEN) != 0u) {
        *basis = basis_at(direction_of(x, y));
        for (var c = 0u; c < 3u; c++) {
            s.B[c] = background_light(basis, (call.degree + 1u) * (call.degree + 1u), c);
            s.behind[c] = s.B[c];
            if ((call.mode & LINEAR) != 0u) { s.behind[c] = to_display(s.B[c]).x; }
        }
    } else {
        s.behind = vec3f(numbers[COLOR_BEHIND], numbers[COLOR_BEHIND + 1u], numbers[COLOR_BEHIND + 2u]);
    }
    s.color += s.T * s.behind;
    s.photo = s.color;
    s.slope = vec3f(1.0);
    if ((call.mode & GAIN) != 0u) {
        let size = vec2f(f32(call.width), f32(call.height));
        let off = vec2f(f32(x), f32(y)) + 0.5 - vec2f(numbers[CENTRE], numbers[CENTRE + 1u]) * size;
        s.squared = dot(off, off) * (4.0 / dot(size, size));
        var change = 0.0;
        for (var j = 3u; j > 0u; j--) { change = (change + numbers[VIGNETTING + j - 1u]) * s.squared; }
        s.polynomial = 1.0 + change;
        s.vignetting = clamp(s.polynomial, numbers[BOUNDS], numbers[BOUNDS + 1u]);
        var factor = s.vignetting;
        let most_beam = numbers[BEAM + BEAM_TERMS];
        if (most_beam > 0.0) {
            s.place = (vec2f(f32(x), f32(y)) + 0.5 - 0.5 * size) * (2.0 / length(size));
            for (var term = 0u; term < BEAM_TERMS; term++) { s.log_beam += numbers[BEAM + term] * beam_term(s.place, term); }
            factor *= exp(clamp(s.log_beam, -most_beam, most_beam));
        }
        for (var c = 0u; c < 3u; c++) {
            let linear = to_light(s.color[c]);
            let applied = factor * numbers[GAINS + c];
            let display = to_display(linear.x * applied);
            s.light[c] = linear.x * applied;
            s.photo[c] = display.x;
            s.slope[c] = display.y * applied * linear.y;
        }
    }
    if (!s.valid) { s.photo = s.wanted; }
    return s;
}

// photo and aim (height, width, 3): the rendered photo and the training image, equal where a pixel is not valid.
@compute @workgroup_size(256)
fn photo_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                 @builtin(local_invocation_index) thread: u32) {
    let at = group_index(group, groups) * THREADS + thread;
    if (at >= call.width * call.height) { return; }
    var basis: array<f32, 16>;
    let s = pixel_seen(at, &basis);
    for (var c = 0u; c < 3u; c++) {
        photo[3u * at + c] = s.photo[c];
        aim[3u * at + c] = s.wanted[c];
    }
}

// Gradients by the blended image and by alpha, and sums; a group takes every so many pixels.
@compute @workgroup_size(256)
fn photo_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                  @builtin(local_invocation_index) thread: u32) {
    var total: array<f32, 54>;
    let used = (call.degree + 1u) * (call.degree + 1u);
    for (var at = group.x * THREADS + thread; at < call.width * call.height; at += groups.x * THREADS) {
        var basis: array<f32, 16>;
        let s = pixel_seen(at, &basis);
        let error = s.photo - s.wanted;
        total[0] += abs(error.x) + abs(error.y) + abs(error.z);
        total[1] += dot(error, error);
        var by = call.square * error + call.absolute * sign(error);
        if ((call.mode & SIMILARITY) != 0u) { by += vec3f(by_photo[3u * at], by_photo[3u * at + 1u], by_photo[3u * at + 2u]); }
        if (!s.valid) { by = vec3f(0.0); }
        if ((call.mode & GAIN) != 0u) {
            var by_log_factor = 0.0;
            for (var c = 0u; c < 3u; c++) {
                let by_log = by[c] * to_display(s.light[c]).y * s.light[c];
                total[3u + c] += by_log;
                by_log_factor += by_log;
            }
            var by_term = by_log_factor / s.vignetting;
            if (s.polynomial < numbers[BOUNDS] || s.polynomial > numbers[BOUNDS + 1u]) { by_term = 0.0; }
            for (var j = 0u; j < 3u; j++) {
                by_term *= s.squared;
                total[6u + j] += by_term;
            }
            let most_beam = numbers[BEAM + BEAM_TERMS];
            if (most_beam > 0.0 && abs(s.log_beam) <= most_beam) {
                for (var term = 0u; term < BEAM_TERMS; term++) { total[9u + term] += by_log_factor * beam_term(s.place, term); }
            }
            by *= s.slope;
        }
        for (var c = 0u; c < 3u; c++) { total[23u + c] += by[c] * s.T; }
        by_blended[at] = vec4f(by, 0.0);
        var through_alpha = -dot(by, s.behind);
        if ((call.mode & OPEN) != 0u) {
            for (var c = 0u; c < 3u; c++) {
                var slope = 1.0;
                if ((call.mode & LINEAR) != 0u) { slope = to_display(s.B[c]).y; }
                let by_raw = by[c] * s.T * slope * s.B[c] * (1.0 - s.B[c]);
                for (var k = 0u; k < used; k++) { total[26u + 3u * k + c] += by_raw * basis[k]; }
            }
            if (s.valid && call.open > 0.0 && s.T > call.closed) {
                let apart = abs(s.wanted - s.behind);
                let surface = clamp((max(max(apart.x, apart.y), apart.z) - call.least) / (call.most - call.least), 0.0, 1.0);
                through_alpha -= call.open * surface;
                total[2] += surface * (s.T - call.closed);
            }
        } else if (s.surface && s.T > call.closed) {
            through_alpha -= call.open;
            total[2] += s.T - call.closed;
        }
        by_transparent[at] = through_alpha;
    }
    for (var k = 0u; k < SUMS; k++) {
        partial[thread] = total[k];
        for (var step = THREADS / 2u; step > 0u; step /= 2u) {
            workgroupBarrier();
            if (thread < step) { partial[thread] += partial[thread + step]; }
        }
        if (thread == 0u) { pixel_sums[group.x * SUMS + k] = partial[0]; }
        workgroupBarrier();
    }
}
