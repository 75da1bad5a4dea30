// L1 and SSIM of two images (height, width, 3) and their gradient; ssim.cpp says what is computed. A group is 16 x 16
// pixels.
const CHANNELS = 3u;
const REACH = 5;       // pixels from the centre of the window to its end
const SQUARE = 16u;    // width and height of a group, pixels
const PADDED = 26u;    // with the neighbours
const AREA = 676u;     // PADDED * PADDED
const STRIPS = 416u;   // PADDED * SQUARE

struct Call { height: u32, width: u32, l1_factor: f32, ssim_factor: f32 }
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec2f>;
@group(0) @binding(4) var<storage, read_write> derivatives: array<f32>;  // (3, height, width, 3), as in ssim.cu
@group(0) @binding(5) var<storage, read> slopes: array<f32>;             // the same
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;

var<workgroup> pair: array<vec2f, 676>;
var<workgroup> pair_rows: array<array<f32, 5>, 416>;
var<workgroup> triple: array<vec3f, 676>;
var<workgroup> triple_rows: array<array<f32, 3>, 416>;
var<workgroup> partial: array<vec2f, 256>;

// Upper left pixel of a group.
fn corner_of(group: u32) -> vec2i {
    let across = (call.width + SQUARE - 1u) / SQUARE;
    return vec2i(vec2u(group % across, group / across) * SQUARE);
}

// The padded pixel i of a group in the image, -1 beyond it.
fn padded(i: u32, corner: vec2i) -> i32 {
    let at = corner + vec2i(vec2u(i % PADDED, i / PADDED)) - REACH;
    let inside = all(at >= vec2i(0)) && at.x < i32(call.width) && at.y < i32(call.height);
    return select(-1, at.y * i32(call.width) + at.x, inside);
}

@compute @workgroup_size(256)
fn l1_ssim_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                   @builtin(local_invocation_index) thread: u32) {
    let number = group_index(group, groups);
    let corner = corner_of(number);
    let place = vec2u(thread % SQUARE, thread / SQUARE);
    let pixel = vec2u(corner) + place;
    let plane = call.height * call.width * CHANNELS;
    var total = vec2f(0.0);
    for (var channel = 0u; channel < CHANNELS; channel++) {
        for (var i = thread; i < AREA; i += THREADS) {
            let source = padded(i, corner);
            var both = vec2f(0.0);
            if (source >= 0) { both = vec2f(image[u32(source) * 3u + channel], wanted[u32(source) * 3u + channel]); }
            pair[i] = both;
        }
        workgroupBarrier();
        for (var i = thread; i < STRIPS; i += THREADS) {
            var row = array<f32, 5>();
            for (var d = -REACH; d <= REACH; d++) {
                let both = pair[i / SQUARE * PADDED + u32(i32(i % SQUARE) + REACH + d)];
                let weighted = WINDOW[abs(d)] * both;
                row[0] += weighted.x;
                row[1] += weighted.y;
                row[2] += weighted.x * both.x;
                row[3] += weighted.y * both.y;
                row[4] += weighted.x * both.y;
            }
            pair_rows[i] = row;
        }
        workgroupBarrier();
        if (pixel.x < call.width && pixel.y < call.height) {
            var blurred = array<f32, 5>();
            for (var d = -REACH; d <= REACH; d++) {
                let source = u32(i32(place.y) + REACH + d) * SQUARE + place.x;
                for (var k = 0u; k < 5u; k++) { blurred[k] += WINDOW[abs(d)] * pair_rows[source][k]; }
            }
            let ma = blurred[0]; let mb = blurred[1]; let mab = ma * mb; let mm = ma * ma + mb * mb;
            let a1 = 2.0 * mab + SSIM_C1; let a2 = 2.0 * (blurred[4] - mab) + SSIM_C2;
            let b1 = mm + SSIM_C1; let b2 = blurred[2] + blurred[3] - mm + SSIM_C2;
            let inverse = 1.0 / (b1 * b2);
            let s = a1 * a2 * inverse;
            let at = (pixel.y * call.width + pixel.x) * CHANNELS + channel;
            total += vec2f(abs(image[at] - wanted[at]), s);
            derivatives[at] = 2.0 * inverse * (mb * (a2 - a1) + ma * s * (b1 - b2));
            derivatives[at + plane] = -s * b1 * inverse;
            derivatives[at + 2u * plane] = 2.0 * a1 * inverse;
        }
        workgroupBarrier();
    }
    partial[thread] = total;
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) { partial[thread] += partial[thread + step]; }
    }
    if (thread == 0u && number < arrayLength(&sums)) { sums[number] = partial[0]; }
}

// gradient = l1_factor sign(image - wanted) + ssim_factor d(sum of SSIM)/d(image).
@compute @workgroup_size(256)
fn l1_ssim_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                    @builtin(local_invocation_index) thread: u32) {
    let corner = corner_of(group_index(group, groups));
    let place = vec2u(thread % SQUARE, thread / SQUARE);
    let pixel = vec2u(corner) + place;
    let plane = call.height * call.width * CHANNELS;
    for (var channel = 0u; channel < CHANNELS; channel++) {
        for (var i = thread; i < AREA; i += THREADS) {
            let source = padded(i, corner);
            var all_three = vec3f(0.0);
            if (source >= 0) {
                let at = u32(source) * 3u + channel;
                all_three = vec3f(slopes[at], slopes[at + plane], slopes[at + 2u * plane]);
            }
            triple[i] = all_three;
        }
        workgroupBarrier();
        for (var i = thread; i < STRIPS; i += THREADS) {
            var row = vec3f(0.0);
            for (var d = -REACH; d <= REACH; d++) {
                row += WINDOW[abs(d)] * triple[i / SQUARE * PADDED + u32(i32(i % SQUARE) + REACH + d)];
            }
            triple_rows[i] = array<f32, 3>(row.x, row.y, row.z);
        }
        workgroupBarrier();
        if (pixel.x < call.width && pixel.y < call.height) {
            var blurred = array<f32, 3>();
            for (var d = -REACH; d <= REACH; d++) {
                let source = u32(i32(place.y) + REACH + d) * SQUARE + place.x;
                for (var k = 0u; k < 3u; k++) { blurred[k] += WINDOW[abs(d)] * triple_rows[source][k]; }
            }
            let at = (pixel.y * call.width + pixel.x) * CHANNELS + channel;
            let a = image[at]; let b = wanted[at];
            let by_ssim = blurred[0] + 2.0 * a * blurred[1] + b * blurred[2];
            gradient[at] = call.l1_factor * sign(a - b) + call.ssim_factor * by_ssim;
        }
        workgroupBarrier();
    }
}
