// Color by direction: real spherical harmonics up to degree 3, constants and order of reference/harmonics.py. A thread
// per Gaussian and color channel.
struct Call { count: u32, higher: u32, degree: u32 }
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> sh0: array<f32>;
@group(0) @binding(2) var<storage, read> shN: array<f32>;
@group(0) @binding(3) var<storage, read> directions: array<f32>;
@group(0) @binding(4) var<storage, read_write> colors: array<f32>;
@group(0) @binding(5) var<storage, read> shown: array<f32>;
@group(0) @binding(6) var<storage, read> by_colors: array<f32>;
@group(0) @binding(7) var<storage, read_write> by_sh0: array<f32>;
@group(0) @binding(8) var<storage, read_write> by_shN: array<f32>;
@group(0) @binding(9) var<storage, read_write> flags: array<atomic<u32>>;  // as in gaussians.wgsl

const SH0 = 16u;  // bit of `flags`

fn basis_of(i: u32) -> array<f32, 16> { return basis_at(vec3f(directions[3u * i], directions[3u * i + 1u], directions[3u * i + 2u])); }

@compute @workgroup_size(256)
fn sh_forward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
              @builtin(local_invocation_index) thread: u32) {
    let at = group_index(group, groups) * THREADS + thread;
    let i = at / 3u;
    if (i >= call.count) { return; }
    var basis = basis_of(i);
    let used = (call.degree + 1u) * (call.degree + 1u) - 1u;
    let source = 3u * call.higher * i + at % 3u;
    var color = 0.5 + basis[0] * sh0[at];
    for (var k = 0u; k < used; k++) { color += basis[k + 1u] * shN[source + 3u * k]; }
    if (color < 0.0 && !is_nan(color)) { color = 0.0; }
    colors[at] = color;
}

// The gradients by sh0 and shN, zero where the color was clamped and for coefficients beyond the degree.
@compute @workgroup_size(256)
fn sh_backward(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
               @builtin(local_invocation_index) thread: u32) {
    let at = group_index(group, groups) * THREADS + thread;
    let i = at / 3u;
    if (i >= call.count) { return; }
    var basis = basis_of(i);
    let used = (call.degree + 1u) * (call.degree + 1u) - 1u;
    let to = 3u * call.higher * i + at % 3u;
    let gradient = select(by_colors[at], 0.0, shown[at] == 0.0);
    by_sh0[at] = basis[0] * gradient;
    if (!is_finite(gradient) || is_nan(shown[at])) { atomicOr(&flags[0], SH0); }
    for (var k = 0u; k < call.higher; k++) {
        by_shN[to + 3u * k] = select(0.0, basis[min(k + 1u, 15u)] * gradient, k < used);
    }
}
