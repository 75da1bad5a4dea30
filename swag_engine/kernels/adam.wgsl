// Adam (arXiv 1412.6980), in place; the numbers of a call as in adam.cu.
struct Call { count: u32, step_size: f32, root: f32, weight1: f32, weight2: f32, epsilon: f32 }
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read_write> parameter: array<f32>;
@group(0) @binding(2) var<storage, read> gradient: array<f32>;
@group(0) @binding(3) var<storage, read_write> mean: array<f32>;
@group(0) @binding(4) var<storage, read_write> square: array<f32>;
@group(0) @binding(5) var<storage, read> skipped: array<u32>;  // nothing changes where the first is not 0

@compute @workgroup_size(256)
fn adam_step(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
             @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * THREADS + thread;
    if (i >= call.count || skipped[0] != 0u) { return; }
    let g = gradient[i];
    let m = mean[i] + call.weight1 * (g - mean[i]);
    let s = square[i] + call.weight2 * (g * g - square[i]);
    mean[i] = m;
    square[i] = s;
    parameter[i] -= call.step_size * m / (sqrt(s) / call.root + call.epsilon);
}
