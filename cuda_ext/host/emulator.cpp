// Runs a kernel's blocks, one fiber a thread. A fiber runs until it waits for others; then the next one's turn comes.

#include <cuda_runtime.h>
#include <setjmp.h>
#include <ucontext.h>

#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace emulated {

dim3 thread_index, block_index, block_size, grid_size;

namespace {

constexpr size_t STACK = 128 << 10;
constexpr int MOST_THREADS = 1024, WARP = 32;

struct Fiber {
    ucontext_t context;
    jmp_buf place;
    bool started, done;
    std::unique_ptr<char[]> stack{new char[STACK]};
};

struct Warp {
    uint64_t given[WARP], result[2][WARP];
    unsigned arrived = 0, took_part[2] = {0, 0}, alive = 0;
    Meeting kind = Meeting::sync;
    long meetings = 0;
};

std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<Warp> warps;
int running;
unsigned at_barrier, alive;
long barriers;
jmp_buf scheduler;
const std::function<void()>* body;
std::string trouble;
std::map<std::string, long> asked_for;

void give_way() {
    const dim3 mine = thread_index;
    if (_setjmp(fibers[running]->place) == 0) _longjmp(scheduler, 1);
    thread_index = mine;
}

void enter() {
    try {
        (*body)();
    } catch (const std::exception& error) {
        trouble = error.what();
    }
    fibers[running]->done = true;
    _longjmp(scheduler, 1);
}

void resume(unsigned k) {
    running = int(k);
    thread_index = dim3(k, 0, 0);
    Fiber& fiber = *fibers[k];
    if (_setjmp(scheduler) != 0) return;
    if (fiber.started) _longjmp(fiber.place, 1);
    fiber.started = true;
    getcontext(&fiber.context);
    fiber.context.uc_stack.ss_sp = fiber.stack.get();
    fiber.context.uc_stack.ss_size = STACK;
    fiber.context.uc_link = nullptr;
    makecontext(&fiber.context, enter, 0);
    setcontext(&fiber.context);
}

void meet_if_all_are_here(Warp& warp, unsigned mask) {
    const unsigned wanted = mask & warp.alive;
    if (warp.arrived == 0 || (warp.arrived & wanted) != wanted) return;
    const long slot = ++warp.meetings & 1;
    std::memcpy(warp.result[slot], warp.given, sizeof warp.given);
    warp.took_part[slot] = warp.arrived;
    warp.arrived = 0;
}

long progress() {
    long total = barriers - long(alive);
    for (const Warp& warp : warps) total += warp.meetings;
    return total;
}

void begin_block(unsigned threads) {
    while (fibers.size() < threads) fibers.push_back(std::make_unique<Fiber>());
    warps.assign((threads + WARP - 1) / WARP, Warp());
    for (unsigned k = 0; k < threads; ++k) {
        fibers[k]->started = fibers[k]->done = false;
        warps[k / WARP].alive |= 1u << (k % WARP);
    }
    alive = threads;
    at_barrier = 0;
    barriers = 0;
}

void run_block(unsigned threads) {
    begin_block(threads);
    static unsigned seed = 1;
    std::vector<unsigned> turns(threads);
    for (unsigned k = 0; k < threads; ++k) turns[k] = k;
    for (int idle = 0; alive > 0;) {
        // another order every round: what a barrier is missing for shows as a result that varies
        for (unsigned k = threads; k > 1; --k) {
            seed = seed * 1664525u + 1013904223u;
            std::swap(turns[k - 1], turns[(seed >> 8) % k]);
        }
        const long before = progress();
        for (unsigned k : turns) {
            if (fibers[k]->done) continue;
            resume(k);
            if (!trouble.empty()) throw std::runtime_error(std::exchange(trouble, ""));
            if (!fibers[k]->done) continue;
            --alive;
            warps[k / WARP].alive &= ~(1u << (k % WARP));
        }
        idle = progress() == before ? idle + 1 : 0;
        if (idle > 2) throw std::runtime_error("the threads of a block wait for one another forever");
    }
}

}  // namespace

void fail(const char* why) { throw std::runtime_error(why); }

unsigned meet_warp(unsigned mask, Meeting kind, uint64_t value, uint64_t* all) {
    Warp& warp = warps[thread_index.x / WARP];
    const int mine = lane();
    if (!(mask >> mine & 1)) fail("a lane calls a warp function whose mask leaves it out");
    if (warp.arrived == 0) warp.kind = kind;
    if (warp.kind != kind) fail("the lanes of a warp meet at different warp functions");
    warp.given[mine] = value;
    warp.arrived |= 1u << mine;
    const long wanted = warp.meetings + 1;
    meet_if_all_are_here(warp, mask);
    while (warp.meetings < wanted) {
        give_way();
        // somebody may have left the kernel meanwhile
        if (warp.meetings < wanted) meet_if_all_are_here(warp, mask);
    }
    std::memcpy(all, warp.result[wanted & 1], sizeof warp.given);
    return warp.took_part[wanted & 1];
}

void meet_block() {
    const long wanted = barriers + 1;
    ++at_barrier;
    while (barriers < wanted) {
        if (at_barrier == alive) {
            at_barrier = 0;
            ++barriers;
            return;
        }
        give_way();
    }
}

void count_nodes(const char* name, int times) { asked_for[name] += times; }

void launch(const char* name, dim3 grid, dim3 block, const std::function<void()>& kernel) {
    count_nodes(name, 1);
    if (grid.x * grid.y * grid.z == 0 || block.x == 0) throw std::runtime_error("a launch of no threads");
    if (block.x > MOST_THREADS || grid.y > 65535u) throw std::runtime_error("a launch that no GPU takes");
    body = &kernel;
    block_size = block;
    grid_size = grid;
    for (unsigned y = 0; y < grid.y; ++y)
        for (unsigned x = 0; x < grid.x; ++x) {
            block_index = dim3(x, y, 0);
            run_block(block.x);
        }
}

}  // namespace emulated

// "name times" a line, of everything since the last call
extern "C" __attribute__((visibility("default"))) const char* emulated_nodes() {
    static std::string lines;
    lines.clear();
    for (const auto& [name, times] : emulated::asked_for) lines += name + " " + std::to_string(times) + "\n";
    emulated::asked_for.clear();
    return lines.c_str();
}
