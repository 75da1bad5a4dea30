// Adam, in place; the numbers of a call as in adam.cu.
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
    let moved = adam_of(Moved(parameter[i], mean[i], square[i]), gradient[i],
                        call.step_size, call.root, call.weight1, call.weight2, call.epsilon);
    parameter[i] = moved.value;
    mean[i] = moved.mean;
    square[i] = moved.square;
}
