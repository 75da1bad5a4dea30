// Colors of Gaussians under a lamp and through water, and back; water.cpp and gaussians.cpp say what is computed. The
// sums of gradients are those of a group, which takes every so many Gaussians.
const SUMS = 34u;           // gradients by the coefficients (33) and by tau
const LEAST_LENGTH = 1e-37; // scene units; keeps the division by the largest component finite

struct Call { count: u32, degree: u32, mode: u32, row: u32, first_sum: u32, dazzling: f32 }
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(2) var<storage, read> colors: array<f32>;
@group(0) @binding(3) var<storage, read> offsets: array<f32>;
@group(0) @binding(4) var<storage, read_write> opacities: array<f32>;
@group(0) @binding(5) var<storage, read_write> shown: array<vec4f>;
@group(0) @binding(6) var<storage, read> gradients: array<f32>;  // (N, row): six moments, then by `shown`
@group(0) @binding(7) var<storage, read_write> by_colors: array<f32>;
@group(0) @binding(8) var<storage, read_write> gaussian_sums: array<f32>;

var<workgroup> partial: array<f32, 256>;

// Direction from the camera, and range.
fn direction_and_range(i: u32) -> vec4f {
    let offset = vec3f(offsets[3u * i], offsets[3u * i + 1u], offsets[3u * i + 2u]);
    let largest = max(max(max(abs(offset.x), abs(offset.y)), abs(offset.z)), LEAST_LENGTH);
    let scaled = offset / largest;
    let size = length(scaled);
    return vec4f(select(vec3f(0.0), scaled / size, size > 0.0), size * largest);
}

fn lamp_light(range: f32) -> f32 {
    if ((call.mode & LAMP) == 0u) { return 1.0; }
    let relative = range / numbers[UNIT_RANGE];
    return (numbers[TAU] + 1.0) / (numbers[TAU] + relative * relative);
}

// A color under the lamp, and the slope by the color.
fn lit(color: f32, light: f32) -> vec2f {
    if ((call.mode & LAMP) == 0u) { return vec2f(color, 1.0); }
    let linear = to_light(color);
    let display = to_display(linear.x * light);
    return vec2f(display.x, display.y * light * linear.y);
}

fn undazzled(display: f32) -> f32 { return select(min(display, call.dazzling), display, is_nan(display)); }

// Also sets the opacities of Gaussians to 0 whose color is not finite.
@compute @workgroup_size(256)
fn shade_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                 @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    let place = direction_and_range(i);
    let light = lamp_light(place.w);
    var basis = basis_at(place.xyz);
    var result = vec3f(0.0);
    for (var c = 0u; c < 3u; c++) {
        var value = lit(colors[3u * i + c], light).x;
        if ((call.mode & WATER) != 0u) {
            value = undazzled(value);
            if ((call.mode & LINEAR) != 0u) { value = to_light(value).x; }
            let B = background_light(&basis, (call.degree + 1u) * (call.degree + 1u), c);
            value = value * exp(-numbers[BETA_D + c] * place.w) + B * (1.0 - exp(-numbers[BETA_B + c] * place.w));
            if ((call.mode & LINEAR) != 0u) { value = to_display(value).x; }
        }
        result[c] = value;
    }
    shown[i] = vec4f(result, 0.0);
    if (!(is_finite(result.x) && is_finite(result.y) && is_finite(result.z))) { opacities[i] = 0.0; }
}

@compute @workgroup_size(256)
fn shade_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                  @builtin(local_invocation_index) thread: u32) {
    var total: array<f32, 34>;
    let used = (call.degree + 1u) * (call.degree + 1u);
    for (var i = group.x * THREADS + thread; i < call.count; i += groups.x * THREADS) {
        let place = direction_and_range(i);
        let light = lamp_light(place.w);
        var basis = basis_at(place.xyz);
        for (var c = 0u; c < 3u; c++) {
            let color = colors[3u * i + c];
            let under_lamp = lit(color, light);
            var by = gradients[i * call.row + 6u + c];
            if ((call.mode & WATER) != 0u) {
                var J = vec2f(undazzled(under_lamp.x), 1.0);
                if ((call.mode & LINEAR) != 0u) { J = to_light(J.x); }
                let transmission = exp(-numbers[BETA_D + c] * place.w);
                let remains = exp(-numbers[BETA_B + c] * place.w);
                let B = background_light(&basis, used, c);
                if ((call.mode & LINEAR) != 0u) { by *= to_display(J.x * transmission + B * (1.0 - remains)).y; }
                total[c] -= by * J.x * transmission * place.w;
                total[3u + c] += by * B * remains * place.w;
                let by_raw = by * (1.0 - remains) * B * (1.0 - B);
                for (var k = 0u; k < used; k++) { total[BACKGROUND + 3u * k + c] += by_raw * basis[k]; }
                by = select(by * transmission * J.y, 0.0, under_lamp.x >= call.dazzling);
            }
            if ((call.mode & LAMP) != 0u) {
                let linear = to_light(color).x * light;
                let relative = place.w / numbers[UNIT_RANGE];
                let slope = 1.0 / (numbers[TAU] + 1.0) - 1.0 / (numbers[TAU] + relative * relative);
                total[COEFFICIENTS] += by * to_display(linear).y * linear * slope;
            }
            by_colors[3u * i + c] = by * under_lamp.y;
        }
    }
    for (var k = 0u; k < SUMS; k++) {
        partial[thread] = total[k];
        for (var step = THREADS / 2u; step > 0u; step /= 2u) {
            workgroupBarrier();
            if (thread < step) { partial[thread] += partial[thread + step]; }
        }
        if (thread == 0u) { gaussian_sums[(call.first_sum + group.x) * SUMS + k] = partial[0]; }
        workgroupBarrier();
    }
}
