// Exclusive sums and a stable radix sort of pairs of 32-bit numbers, four bits a pass. Sums are made in blocks, then those
// of the blocks, in dispatches of their own: no group waits for another one. Who reads a sum adds its block's.
const RADIX_BITS = 4u;
const RADIX = 16u;
const ITEMS = 4u;     // keys of a thread
const BLOCK = 1024u;  // keys of a group

struct Call { count: u32, shift: u32, blocks: u32 }
@group(0) @binding(0) var<uniform> call: Call;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> data: array<u32>;
@group(0) @binding(6) var<storage, read_write> sums: array<u32>;  // the total, then what each block begins with

var<workgroup> partial: array<u32, 256>;
var<workgroup> digit_counts: array<atomic<u32>, 16>;
var<workgroup> counters: array<u32, 2048>;  // a digit and a thread: two of 16 bits in a word

// Exclusive sum over the group; the total is left in partial[255].
fn sum_before(thread: u32, value: u32) -> u32 {
    partial[thread] = value;
    workgroupBarrier();
    for (var step = 1u; step < THREADS; step *= 2u) {
        var add = 0u;
        if (thread >= step) { add = partial[thread - step]; }
        workgroupBarrier();
        partial[thread] += add;
        workgroupBarrier();
    }
    return partial[thread] - value;
}

@compute @workgroup_size(256)
fn sum_blocks(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
              @builtin(local_invocation_index) thread: u32) {
    let block = group_index(group, groups);
    let first = block * BLOCK + thread * ITEMS;
    var before: array<u32, 4>;
    var sum = 0u;
    for (var i = 0u; i < ITEMS; i++) {
        before[i] = sum;
        if (first + i < call.count) { sum += data[first + i]; }
    }
    let start = sum_before(thread, sum);
    for (var i = 0u; i < ITEMS; i++) {
        if (first + i < call.count) { data[first + i] = start + before[i]; }
    }
    if (thread == THREADS - 1u && block < call.blocks) { sums[block + 1u] = start + sum; }
}

// One group: sums of the blocks.
@compute @workgroup_size(256)
fn sum_totals(@builtin(local_invocation_index) thread: u32) {
    var carry = 0u;
    for (var start = 0u; start < call.blocks; start += THREADS) {
        let i = start + thread;
        var value = 0u;
        if (i < call.blocks) { value = sums[i + 1u]; }
        let before = sum_before(thread, value);
        if (i < call.blocks) { sums[i + 1u] = carry + before; }
        carry += partial[THREADS - 1u];
        workgroupBarrier();
    }
    if (thread == 0u) { sums[0] = carry; }
}

// data (RADIX, blocks): how often each block has each digit.
@compute @workgroup_size(256)
fn count_digits(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                @builtin(local_invocation_index) thread: u32) {
    let block = group_index(group, groups);
    if (thread < RADIX) { atomicStore(&digit_counts[thread], 0u); }
    workgroupBarrier();
    for (var i = 0u; i < ITEMS; i++) {
        let at = block * BLOCK + i * THREADS + thread;
        if (at < call.count) { atomicAdd(&digit_counts[(keys_in[at] >> call.shift) & (RADIX - 1u)], 1u); }
    }
    workgroupBarrier();
    if (thread < RADIX && block < call.blocks) {
        data[thread * call.blocks + block] = atomicLoad(&digit_counts[thread]);
    }
}

// Moves each key and value to its place; data as count_digits left it, summed in blocks.
@compute @workgroup_size(256)
fn move_by_digit(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                 @builtin(local_invocation_index) thread: u32) {
    let block = group_index(group, groups);
    for (var d = 0u; d < 8u; d++) { counters[d * THREADS + thread] = 0u; }
    let first = block * BLOCK + thread * ITEMS;
    let own = min(ITEMS, max(call.count, first) - first);
    for (var i = 0u; i < own; i++) {
        let digit = (keys_in[first + i] >> call.shift) & (RADIX - 1u);
        counters[(digit & 7u) * THREADS + thread] += 1u << ((digit >> 3u) * 16u);
    }
    workgroupBarrier();
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) { sum += counters[thread * 8u + i]; }
    var before = sum_before(thread, sum);
    before += (partial[THREADS - 1u] & 0xffffu) << 16u;
    for (var i = 0u; i < 8u; i++) {
        let value = counters[thread * 8u + i];
        counters[thread * 8u + i] = before;
        before += value;
    }
    workgroupBarrier();
    if (thread < RADIX && block < call.blocks) {
        let rank = (counters[(thread & 7u) * THREADS] >> ((thread >> 3u) * 16u)) & 0xffffu;
        let at = thread * call.blocks + block;
        partial[thread] = data[at] + sums[at / BLOCK + 1u] - rank;
    }
    workgroupBarrier();
    for (var i = 0u; i < own; i++) {
        let key = keys_in[first + i];
        let digit = (key >> call.shift) & (RADIX - 1u);
        let word = (digit & 7u) * THREADS + thread;
        let half = (digit >> 3u) * 16u;
        let to = partial[digit] + ((counters[word] >> half) & 0xffffu);
        counters[word] += 1u << half;
        keys_out[to] = key;
        values_out[to] = values_in[first + i];
    }
}
