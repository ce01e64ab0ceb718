// What a processor can do at most: multiply-adds on vectors of sixteen floats, in twelve chains side by side, which is
// more than it keeps in flight; and passes over memory.
#include <cstdint>

typedef float Vector __attribute__((vector_size(64)));
constexpr int CHAINS = 12;

// does rounds * CHAINS of them; the result keeps the compiler from leaving them out
extern "C" float multiply_adds(int64_t rounds, float factor, float term) {
  Vector chains[CHAINS];
  for (int k = 0; k < CHAINS; k++) chains[k] = Vector{} + float(k);
  const Vector factors = Vector{} + factor, terms = Vector{} + term;
  for (int64_t round = 0; round < rounds; round++)
    for (int k = 0; k < CHAINS; k++) chains[k] = chains[k] * factors + terms;
  Vector sum = {};
  for (int k = 0; k < CHAINS; k++) sum += chains[k];
  return sum[0];
}

extern "C" int64_t chains() { return CHAINS; }

// goes over some numbers so many times, reading and writing each
extern "C" void passes(float *numbers, int64_t n, int64_t rounds) {
  for (int64_t round = 0; round < rounds; round++) {
    for (int64_t k = 0; k < n; k++) numbers[k] += 1.0f;
    asm volatile("" : : "r"(numbers) : "memory");  // or several rounds become one
  }
}
