// Shared by the CUDA kernels. NVRTC compiles them to PTX without headers of CUDA or of C.
#pragma once

typedef long long Index;  // type of every integer argument: buffers may hold more than 2^31 numbers

constexpr int THREADS = 256;                 // threads of every block: a tile of 16 x 16 pixels
constexpr int WARP = 32;                     // threads of a warp, on all cards
constexpr int WARPS = THREADS / WARP;        // warps of a block
constexpr unsigned ALL_LANES = 0xffffffffu;  // mask of all threads of a warp

// Declares a kernel of which `blocks` blocks fit on a multiprocessor: that bounds the registers, to where none spill.
#define KERNEL(blocks) extern "C" __global__ void __launch_bounds__(THREADS, blocks)

__device__ inline Index thread_index() { return (Index)blockIdx.x * THREADS + threadIdx.x; }

// Sums each of N values over the lanes of a warp; lane_value says which of the sums a lane then holds. At each step a
// lane sends one half of its values to its partner and adds what it receives to the other half: 12 shuffles for 9
// values.
template <int N, int STEP = WARP / 2>
__device__ inline float lane_sum(const float (&values)[N], int lane) {
    if constexpr (STEP == 0) {
        return values[0];
    } else {
        constexpr int HALF = (N + 1) / 2;
        bool upper = lane & STEP;
        float kept[HALF];
#pragma unroll
        for (int i = 0; i < HALF; i++) {
            float low = values[i], high = HALF + i < N ? values[(HALF + i) % N] : 0.f;
            kept[i] = (upper ? high : low) + __shfl_xor_sync(ALL_LANES, upper ? low : high, STEP);
        }
        return lane_sum<HALF, STEP / 2>(kept, lane);
    }
}

// The number of the value that `lane` holds after lane_sum, N or more for a lane without one.
template <int N, int STEP = WARP / 2>
__device__ inline int lane_value(int lane) {
    if constexpr (STEP == 0) {
        return 0;
    } else {
        constexpr int HALF = (N + 1) / 2;
        int inner = lane_value<HALF, STEP / 2>(lane);
        return inner < HALF ? inner + (lane & STEP ? HALF : 0) : N;
    }
}

// sums (blocks, N): totals of N values over the threads of each block.
template <int N>
__device__ inline void block_sums(const float (&given)[N], float *sums) {
    __shared__ float of_warp[WARPS][N];
    int lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    for (int k = 0; k < N; k++) {
        float one[1] = {given[k]}, total = lane_sum(one, lane);
        if (lane_value<1>(lane) == 0) of_warp[warp][k] = total;
    }
    __syncthreads();
    if (threadIdx.x >= N) return;
    float total = 0;
    for (int w = 0; w < WARPS; w++) total += of_warp[w][threadIdx.x];
    sums[(Index)blockIdx.x * N + threadIdx.x] = total;
}
