// 3D Gaussians to 2D Gaussians, forward and backward, with the formulas of reference/projection.py: a thread per
// Gaussian. There is no double: the camera's position comes as a sum of two floats, so that distant origins keep their
// digits.
struct Call {
    row0: vec4f, row1: vec4f, row2: vec4f,  // rotation, world to camera
    origin: vec4f, origin_rest: vec4f,      // position of the camera, scene units: their sum
    intrinsics: vec4f,                      // fx, fy, cx, cy, pixels
    count: u32, width: u32, height: u32, orthographic: u32,
}
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> quats: array<f32>;
@group(0) @binding(3) var<storage, read> scales: array<f32>;
@group(0) @binding(4) var<storage, read> opacities: array<f32>;
@group(0) @binding(5) var<storage, read_write> means2d: array<f32>;
@group(0) @binding(6) var<storage, read_write> conics: array<f32>;
@group(0) @binding(7) var<storage, read_write> depths: array<f32>;
@group(0) @binding(8) var<storage, read_write> radii: array<f32>;
@group(0) @binding(9) var<storage, read> incoming: array<f32>;  // (N, 6): gradients by means2d, conics and opacities
@group(0) @binding(10) var<storage, read_write> by_means: array<f32>;
@group(0) @binding(11) var<storage, read_write> by_quats: array<f32>;
@group(0) @binding(12) var<storage, read_write> by_scales: array<f32>;

// One Gaussian as the camera sees it, with what the backward pass needs again.
struct Projected {
    drawn: bool,                     // false where it is behind the near plane or not finite
    z: f32, u: f32, v: f32,          // u = x/z, v = y/z; orthographic: u = x, v = y
    u_held: bool, v_held: bool,      // beyond the guard band
    row_x: vec3f, row_y: vec3f,      // J R
    inverse_norm: f32, q: vec4f,     // of the quaternion; the unit quaternion wxyz
    axes: mat3x3f,                   // columns of the rotation matrix
    sigma: vec3f, along_x: vec3f, along_y: vec3f,  // along_x[k] = row_x . axes[k]
    covariance: vec3f,               // xx, xy, yy, pixel^2
    conic: vec3f,
}

fn project_one(i: u32) -> Projected {
    var p: Projected;
    let mean = vec3f(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let scale = vec3f(scales[3u * i], scales[3u * i + 1u], scales[3u * i + 2u]);
    var quat = vec4f(quats[4u * i], quats[4u * i + 1u], quats[4u * i + 2u], quats[4u * i + 3u]);
    let offset = (mean - call.origin.xyz) - call.origin_rest.xyz;
    let at = vec3f(dot(call.row0.xyz, offset), dot(call.row1.xyz, offset), dot(call.row2.xyz, offset));
    p.z = at.z;
    var finite = true;
    for (var k = 0u; k < 3u; k++) { finite = finite && is_finite(at[k]) && is_finite(scale[k]); }
    for (var k = 0u; k < 4u; k++) { finite = finite && is_finite(quat[k]); }
    p.drawn = finite && at.z > NEAR;
    if (!p.drawn) { return p; }
    let f = call.intrinsics.xy;
    let size = vec2f(f32(call.width), f32(call.height));
    if (call.orthographic == 1u) {
        p.u = at.x;
        p.v = at.y;
        p.row_x = f.x * call.row0.xyz;
        p.row_y = f.y * call.row1.xyz;
    } else {
        p.u = at.x / at.z;
        p.v = at.y / at.z;
        let guard = GUARD * size / (2.0 * f);
        let low = -call.intrinsics.zw / f - guard;
        let high = (size - call.intrinsics.zw) / f + guard;
        let held = clamp(vec2f(p.u, p.v), low, high);
        p.u_held = held.x != p.u;
        p.v_held = held.y != p.v;
        p.row_x = f.x / at.z * (call.row0.xyz - held.x * call.row2.xyz);
        p.row_y = f.y / at.z * (call.row1.xyz - held.y * call.row2.xyz);
    }
    let largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
    let shrink = select(1.0, 1e-20, largest > 1e15);  // so that the squares stay below infinity
    quat *= shrink;
    let scaling = 1.0 / sqrt(max(dot(quat, quat), 1e-12));
    p.q = quat * scaling;
    p.inverse_norm = scaling * shrink;
    let w = p.q.x; let x = p.q.y; let y = p.q.z; let z = p.q.w;
    p.axes = mat3x3f(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
    let max_sigma = MAX_SIGMA / max(f.x, f.y) * select(at.z, 1.0, call.orthographic == 1u);
    p.sigma = min(scale, vec3f(max_sigma));
    p.along_x = p.row_x * p.axes;
    p.along_y = p.row_y * p.axes;
    let mx = p.along_x * p.sigma;
    let my = p.along_y * p.sigma;
    let xx = dot(mx, mx);
    let xy = dot(mx, my);
    let yy = dot(my, my);
    let minors = cross(mx, my);
    // Cauchy-Binet: never negative.
    let inverse_det = 1.0 / (dot(minors, minors) + BLUR * (xx + yy) + BLUR * BLUR);
    p.conic = vec3f(yy + BLUR, -xy, xx + BLUR) * inverse_det;
    p.covariance = vec3f(xx + BLUR, xy, yy + BLUR);
    return p;
}

// means2d (N, 2), conics (N, 3), depths (N,), radii (N,); zeros where nothing is to be drawn.
@compute @workgroup_size(256)
fn project_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                   @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    let opacity = opacities[i];
    var extent = 0.0;
    if (is_finite(opacity) && opacity > 0.0) { extent = 2.0 * log(255.0 * opacity); }
    let p = project_one(i);
    let center = call.intrinsics.xy * vec2f(p.u, p.v) + call.intrinsics.zw;
    let half = (p.covariance.x - p.covariance.z) / 2.0;
    let largest = (p.covariance.x + p.covariance.z) / 2.0 + sqrt(half * half + p.covariance.y * p.covariance.y);
    let reach = sqrt(extent * p.covariance.xz);
    var drawn = p.drawn && extent > 0.0 && extent < MAX_EXTENT && all(center + reach > vec2f(0.0));
    drawn = drawn && all(center - reach < vec2f(f32(call.width), f32(call.height)));
    means2d[2u * i] = select(0.0, center.x, drawn);
    means2d[2u * i + 1u] = select(0.0, center.y, drawn);
    for (var k = 0u; k < 3u; k++) { conics[3u * i + k] = select(0.0, p.conic[k], drawn); }
    depths[i] = select(0.0, p.z, drawn);
    radii[i] = select(0.0, sqrt(extent * largest), drawn);
}

// From gradients by means2d and conics to those by means (N, 3), quats (N, 4) and scales (N, 3).
@compute @workgroup_size(256)
fn project_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                    @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count) { return; }
    let p = project_one(i);
    if (!(radii[i] > 0.0 && p.drawn)) {
        for (var k = 0u; k < 3u; k++) {
            by_means[3u * i + k] = 0.0;
            by_scales[3u * i + k] = 0.0;
        }
        for (var k = 0u; k < 4u; k++) { by_quats[4u * i + k] = 0.0; }
        return;
    }
    // By the covariance: -Q G Q, with Q the conic and G its gradient as a symmetric matrix.
    let A = p.conic.x; let B = p.conic.y; let C = p.conic.z;
    let ga = incoming[6u * i + 2u]; let gb = 0.5 * incoming[6u * i + 3u]; let gc = incoming[6u * i + 4u];
    let xx = -(A * A * ga + 2.0 * A * B * gb + B * B * gc);
    let yy = -(B * B * ga + 2.0 * B * C * gb + C * C * gc);
    let xy = -2.0 * (A * B * ga + (A * C + B * B) * gb + B * C * gc);
    var by_row_x = vec3f(0.0); var by_row_y = vec3f(0.0); var by_axes: mat3x3f;
    for (var k = 0u; k < 3u; k++) {
        let mx = p.along_x[k] * p.sigma[k];
        let my = p.along_y[k] * p.sigma[k];
        let by_mx = 2.0 * xx * mx + xy * my;
        let by_my = 2.0 * yy * my + xy * mx;
        let limited = p.sigma[k] != scales[3u * i + k];
        by_scales[3u * i + k] = select(by_mx * p.along_x[k] + by_my * p.along_y[k], 0.0, limited);
        by_row_x += by_mx * p.sigma[k] * p.axes[k];
        by_row_y += by_my * p.sigma[k] * p.axes[k];
        by_axes[k] = p.sigma[k] * (by_mx * p.row_x + by_my * p.row_y);
    }
    let f = call.intrinsics.xy;
    var by_u = f.x * incoming[6u * i];
    var by_v = f.y * incoming[6u * i + 1u];
    var by_mean: vec3f;
    if (call.orthographic == 1u) {  // the covariance does not depend on the place
        by_mean = by_u * call.row0.xyz + by_v * call.row1.xyz;
    } else {
        var by_z = -(by_u * p.u + by_v * p.v) / p.z - (dot(by_row_x, p.row_x) + dot(by_row_y, p.row_y)) / p.z;
        if (!p.u_held) {
            let held = -f.x / p.z * dot(by_row_x, call.row2.xyz);
            by_u += held;
            by_z -= held * p.u / p.z;
        }
        if (!p.v_held) {
            let held = -f.y / p.z * dot(by_row_y, call.row2.xyz);
            by_v += held;
            by_z -= held * p.v / p.z;
        }
        by_mean = (by_u * call.row0.xyz + by_v * call.row1.xyz) / p.z + by_z * call.row2.xyz;
    }
    for (var k = 0u; k < 3u; k++) { by_means[3u * i + k] = by_mean[k]; }
    // Sums s and differences d of the gradient by the rotation matrix's entries; by_axes[column][row].
    let s01 = by_axes[1][0] + by_axes[0][1]; let s02 = by_axes[2][0] + by_axes[0][2]; let s12 = by_axes[2][1] + by_axes[1][2];
    let d10 = by_axes[0][1] - by_axes[1][0]; let d02 = by_axes[2][0] - by_axes[0][2]; let d21 = by_axes[1][2] - by_axes[2][1];
    let w = p.q.x; let x = p.q.y; let y = p.q.z; let z = p.q.w;
    let by_unit = vec4f(
        2.0 * (z * d10 + y * d02 + x * d21),
        2.0 * (y * s01 + z * s02 + w * d21) - 4.0 * x * (by_axes[1][1] + by_axes[2][2]),
        2.0 * (x * s01 + z * s12 + w * d02) - 4.0 * y * (by_axes[0][0] + by_axes[2][2]),
        2.0 * (x * s02 + y * s12 + w * d10) - 4.0 * z * (by_axes[0][0] + by_axes[1][1]));
    // Through the normalisation; a quaternion below its lower bound is only scaled.
    let radial = select(0.0, dot(p.q, by_unit), p.inverse_norm < 1e6);
    let by_quat = p.inverse_norm * (by_unit - radial * p.q);
    for (var k = 0u; k < 4u; k++) { by_quats[4u * i + k] = by_quat[k]; }
}
