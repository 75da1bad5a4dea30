// Runs CUDA kernels on a CPU, unmodified: a fibre per thread, one block after the other. Barriers, shuffles and votes
// are exact; a barrier that some threads never reach is reported. Threads run in one of several orders, so that a
// barrier that is missing shows. Expects all lanes in every warp-wide operation.
#pragma once
#include <math.h>
#include <setjmp.h>
#include <stdio.h>
#include <string.h>
#include <ucontext.h>

#define __global__ __attribute__((used))
#define __device__
#define __shared__ static __attribute__((section("shared_memory")))
#define __launch_bounds__(...)

struct Three {
    unsigned x, y, z;
};
struct float4 {
    float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a > b ? a : b; }
inline float __fdividef(float a, float b) { return a / b; }
inline int __ffs(unsigned bits) { return __builtin_ffs((int)bits); }
inline int __clz(unsigned bits) { return bits ? __builtin_clz(bits) : 32; }
inline int atomicMax(int *at, int value) {
    int old = *at;
    *at = max(old, value);
    return old;
}
inline float __int_as_float(int bits) {
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

Three threadIdx, blockIdx;
extern "C" char __start_shared_memory[], __stop_shared_memory[];  // by the linker, where there is any
__attribute__((used, retain)) __shared__ char any_shared_memory;

namespace fibres {

constexpr int MOST = 1024, LANES = 32, STACK = 1 << 16;

// Threads that wait until `expected` have come. Values go through buffers that alternate: nobody can come to the
// barrier after the next before everybody has left this one.
struct Barrier {
    int waiting[MOST], count, turn;
    unsigned values[2][LANES], vote[2];
};

struct Fibre {
    jmp_buf state;
    ucontext_t context;
    bool started;
    alignas(16) char stack[STACK];
} fibre[MOST];

int current, alive, ready[MOST], first_ready, ready_count;
enum Order { FAIR, FIRST_WARPS_FIRST, LAST_WARPS_FIRST } order;
Barrier block, warp[MOST / LANES];
jmp_buf back_to_launch;
void (*kernel)(void **);
void **arguments;

// Fair: to the end of the queue. Else to its front, so that a warp runs on alone as far as it can.
void make_ready(const int *threads, int count) {
    for (int i = 0; i < count; i++) {
        int place = order == FAIR ? first_ready + ready_count : first_ready += MOST - 1;
        ready[place % MOST] = threads[order == FIRST_WARPS_FIRST ? count - 1 - i : i];
        first_ready %= MOST;
        ready_count++;
    }
}

[[noreturn]] void run_next();

[[noreturn]] void body() {
    for (;;) {
        kernel(arguments);
        alive--;
        if (alive && block.count == alive) {
            make_ready(block.waiting, block.count);
            block.count = 0;
            block.turn ^= 1;
        }
        if (!_setjmp(fibre[current].state)) run_next();  // goes on with the next block
    }
}

void run_next() {
    if (!ready_count) _longjmp(back_to_launch, 1);
    current = ready[first_ready];
    first_ready = (first_ready + 1) % MOST;
    ready_count--;
    threadIdx = {(unsigned)current, 0, 0};
    Fibre &next = fibre[current];
    if (next.started) _longjmp(next.state, 1);
    next.started = true;
    getcontext(&next.context);
    next.context.uc_stack.ss_sp = next.stack;
    next.context.uc_stack.ss_size = STACK;
    makecontext(&next.context, (void (*)())body, 0);
    setcontext(&next.context);
    __builtin_unreachable();
}

// Returns which of the two buffers holds what the threads brought.
__attribute__((noinline)) int wait(Barrier &barrier, int expected, unsigned value) {
    int turn = barrier.turn;
    barrier.values[turn][current % LANES] = value;
    barrier.vote[turn] |= value;
    if (barrier.count + 1 == expected) {
        make_ready(barrier.waiting, barrier.count);
        barrier.count = 0;
        barrier.turn ^= 1;
        barrier.vote[barrier.turn] = 0;
    } else {
        barrier.waiting[barrier.count++] = current;
        if (!_setjmp(fibre[current].state)) run_next();
    }
    asm volatile("" ::: "memory");  // the others have run
    return turn;
}

inline unsigned exchange(unsigned value, int from) {
    Barrier &own = warp[current / LANES];
    int turn = wait(own, LANES, value);
    return own.values[turn][from];
}

// A kernel by name, with a letter for each parameter's type.
struct Entry {
    const char *name, *signature;
    void (*call)(void **);
};

template <class T>
constexpr char letter = 'F';  // Splat among them: a tensor of floats
template <>
constexpr char letter<float> = 'f';
template <>
constexpr char letter<long long> = 'i';
template <>
constexpr char letter<double *> = 'D';
template <>
constexpr char letter<int *> = 'I';
template <>
constexpr char letter<long long *> = 'L';
template <>
constexpr char letter<short *> = 'S';
template <>
constexpr char letter<unsigned char *> = 'B';
template <class T>
constexpr char letter<const T *> = letter<T *>;

template <class T, T...>
struct Numbers {};
template <auto function>
struct Unpack;
template <class... A, void (*function)(A...)>
struct Unpack<function> {
    static constexpr char signature[] = {letter<A>..., 0};
    template <int... I>
    static void call(void **values, Numbers<int, I...>) {
        function(*(A *)values[I]...);
    }
    static void call(void **values) { call(values, __make_integer_seq<Numbers, int, sizeof...(A)>()); }
};

extern const Entry entries[];

inline const Entry *find(const char *name) {
    for (const Entry *entry = entries; entry->name; entry++)
        if (!strcmp(entry->name, name)) return entry;
    return nullptr;
}

}  // namespace fibres

inline void __syncthreads() { fibres::wait(fibres::block, fibres::alive, 0); }
inline int __syncthreads_or(int value) {
    int turn = fibres::wait(fibres::block, fibres::alive, value != 0);
    return fibres::block.vote[turn] != 0;
}
inline unsigned __ballot_sync(unsigned, int value) {
    fibres::Barrier &own = fibres::warp[fibres::current / fibres::LANES];
    int turn = fibres::wait(own, fibres::LANES, value ? 1u << fibres::current % fibres::LANES : 0);
    return own.vote[turn];
}
inline int __any_sync(unsigned lanes, int value) { return __ballot_sync(lanes, value) != 0; }
template <class T>
inline T __shfl_sync(unsigned, T value, int from) {
    unsigned bits;
    static_assert(sizeof bits == sizeof value);
    memcpy(&bits, &value, sizeof bits);
    bits = fibres::exchange(bits, from);
    memcpy(&value, &bits, sizeof bits);
    return value;
}
template <class T>
inline T __shfl_xor_sync(unsigned lanes, T value, int step) {
    return __shfl_sync(lanes, value, fibres::current % fibres::LANES ^ step);
}

extern "C" const char *fibres_signature(const char *name) {
    const fibres::Entry *entry = fibres::find(name);
    return entry ? entry->signature : nullptr;
}

// Returns an error in words, null when all went well.
extern "C" const char *fibres_launch(const char *name, unsigned blocks, unsigned threads, void **arguments, int order) {
    static char message[200];
    fibres::kernel = fibres::find(name)->call;
    fibres::arguments = arguments;
    fibres::order = (fibres::Order)order;
    for (unsigned b = 0; b < blocks; b++) {
        blockIdx = {b, 0, 0};
        memset(__start_shared_memory, 0xff,
               __stop_shared_memory - __start_shared_memory);  // NaN: a block finds nothing
        fibres::alive = (int)threads;
        static int all[fibres::MOST];
        for (unsigned t = 0; t < threads; t++) all[t] = (int)t;
        fibres::make_ready(all, (int)threads);
        if (!_setjmp(fibres::back_to_launch)) fibres::run_next();
        if (!fibres::alive) continue;
        snprintf(message, sizeof message, "%s, block %u: %d threads wait at a barrier that others do not reach", name,
                 blockIdx.x, fibres::alive);
        for (fibres::Fibre &stuck : fibres::fibre) stuck.started = false;
        fibres::block = {};
        for (fibres::Barrier &stuck : fibres::warp) stuck = {};
        return message;
    }
    return nullptr;
}
