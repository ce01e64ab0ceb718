// What a processor can do at most: multiply-adds on the widest vectors that it has, in twelve chains side by side, which
// is more than it keeps in flight; and passes over memory. Wider vectors than it has would be halves in memory: twelve
// chains of them need more registers than there are.
#include <cstdint>

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif
typedef float Vector __attribute__((vector_size(4 * LANES)));
constexpr int CHAINS = 12;

// does rounds * CHAINS of them on vectors; the result keeps the compiler from leaving them out
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

// the multiply-adds of single floats in a round
extern "C" int64_t a_round() { return CHAINS * LANES; }

// goes over some numbers so many times, reading and writing each
extern "C" void passes(float *numbers, int64_t n, int64_t rounds) {
  for (int64_t round = 0; round < rounds; round++) {
    for (int64_t k = 0; k < n; k++) numbers[k] += 1.0f;
    asm volatile("" : : "r"(numbers) : "memory");  // or several rounds become one
  }
}
