// What a step had to do, counted anew from what it left behind, so that counting costs the step nothing.

#include "step.h"

namespace pop {

StepCounts Stepper::counted() const {
  StepCounts found = {};
  if (!ended) return found;
  found.visible = n_visible;
  const Thresholds<float> thresholds(blend);
  Entries<float> entries;
  Rows<float> lines(pixels.size);
  for (int64_t tile = 0; tile < blend.tiles(); tile++) {
    const Place<float> place(blend, tile);
    const int64_t end = place.begin + n_reached[size_t(tile)];
    found.entries += place.end - place.begin;
    found.walked += end - place.begin;
    int64_t chunk = first_chunks[size_t(tile)];
    for (int64_t at = place.begin; at < end; at += CHUNK, chunk++) {
      const int64_t n = std::min<int64_t>(CHUNK, place.end - at);
      entries.gather(blend, place, at, n, at);
      lines.expand(entries, pixels);
      lines.look(entries, pixels, thresholds);
      found.chunks++;
      for (int strip = 0; strip < pixels.strips; strip++) {
        if (!any(load(&blend.transmittances[chunk * pixels.padded() + strip * LANES<float>]) > 0.0f)) continue;
        found.pairs += n * LANES<float>;
        found.marked += __builtin_popcount(lines.of_strip(pixels, strip));
        uint32_t reached = 0;
        for (int piece = 0; piece < PIECES; piece++) reached |= blend.reached[(chunk * pixels.strips + strip) * PIECES + piece];
        found.reached += __builtin_popcount(reached);
      }
    }
  }
  return found;
}

}  // namespace pop

extern "C" void pop_stepper_counts(const void *stepper, pop::StepCounts *to) {
  *to = static_cast<const pop::Stepper *>(stepper)->counted();
}
