"use strict";
// Orders Gaussians from far to near, off the page's thread: a stable radix sort of the depths' bits.

let positions = new Float32Array(0);
let keys = new Uint32Array(0), order = new Uint32Array(0), swap = new Uint32Array(0);
const counts = new Uint32Array(65536);

function pass(from, to, n, shift) {
  counts.fill(0);
  for (let i = 0; i < n; i++) counts[(keys[from[i]] >>> shift) & 65535]++;
  let total = 0;
  for (let k = 0; k < 65536; k++) {
    const here = counts[k];
    counts[k] = total;
    total += here;
  }
  for (let i = 0; i < n; i++) to[counts[(keys[from[i]] >>> shift) & 65535]++] = from[i];
}

onmessage = ({ data }) => {
  if (data.positions) {
    positions = data.positions;
    const n = positions.length / 3;
    keys = new Uint32Array(n);
    order = new Uint32Array(n);
    swap = new Uint32Array(n);
    return;
  }
  const [x, y, z, w, near] = data.row;
  const depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  let n = 0;
  for (let i = 0, j = 0; j < keys.length; i += 3, j++) {
    depth[0] = x * positions[i] + y * positions[i + 1] + z * positions[i + 2] + w;
    if (depth[0] < near) continue;
    // the bits of positive floats rise as they do
    keys[j] = bits[0];
    order[n++] = j;
  }
  pass(order, swap, n, 0);
  pass(swap, order, n, 16);
  const drawn = new Uint32Array(n);
  for (let i = 0; i < n; i++) drawn[i] = order[n - 1 - i];
  postMessage({ order: drawn, id: data.id }, [drawn.buffer]);
};
