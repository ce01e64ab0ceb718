// The toy of pop_ref/learn/splat.py: three balls on a chequered floor, photographed from all around.

const BALLS = [
  { centre: [0, -0.5, 0], radius: 0.5, paint: [0.9, 0.25, 0.2] },
  { centre: [0.9, -0.3, 0.3], radius: 0.3, paint: [0.2, 0.5, 0.9] },
  { centre: [-0.7, -0.35, 0.6], radius: 0.35, paint: [0.95, 0.75, 0.2] },
];

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const normalized = (a) => a.map((x) => x / Math.sqrt(dot(a, a)));
const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

// stand on a circle and look at the middle: world to camera, +x right, +y down, +z forward
function orbit(angle, size) {
  const eye = [3.2 * Math.cos(angle), -1.6, 3.2 * Math.sin(angle)], right = [-Math.sin(angle), 0, Math.cos(angle)];
  const forward = normalized([-eye[0], -0.25 - eye[1], -eye[2]]), rows = [right, cross(forward, right), forward];
  return { R: rows.flat(), t: rows.map((row) => -dot(row, eye)), f: [1.1 * size, 1.1 * size], c: [size / 2, size / 2], size: [size, size] };
}

// trace one ray a pixel: to the floor at y = 0, then to each ball; the nearest hit is seen
function photograph({ R, t, f, c, size: [width, height] }) {
  const image = new Float64Array(3 * width * height), world = turned(R, 3, 3);
  const eye = mul(world, t, 3, 3, 1).map((x) => -x), light = [0.4, -0.8, 0.45];
  for (let p = 0; p < width * height; p += 1) {
    const ray = normalized(mul(world, [((p % width) + 0.5 - c[0]) / f[0], (Math.floor(p / width) + 0.5 - c[1]) / f[1], 1], 3, 3, 1));
    let nearest = ray[1] > 0 ? -eye[1] / Math.max(ray[1], 1e-9) : 0;
    const [x, z] = [eye[0] + nearest * ray[0], eye[2] + nearest * ray[2]];
    const on_floor = nearest > 0 && Math.abs(x) < 1.5 && Math.abs(z) < 1.5;
    let color = [0, 0, 0];
    if (on_floor) color = color.fill(0.35 + 0.4 * (Math.abs(Math.floor(2 * x) + Math.floor(2 * z)) % 2));
    else nearest = Infinity;
    for (const { centre, radius, paint } of BALLS) {
      const to = centre.map((y, k) => y - eye[k]), along = dot(ray, to), inside = along ** 2 - dot(to, to) + radius ** 2;
      const distance = along - Math.sqrt(Math.max(inside, 0));
      if (!(inside > 0 && distance < nearest)) continue;
      const shade = Math.max(dot(ray.map((y, k) => distance * y - to[k]), light) / radius, 0);
      [color, nearest] = [paint.map((y) => (0.25 + 0.75 * shade) * y), distance];
    }
    image.set(color, 3 * p);
  }
  return image;
}

// numbers that are the same for the same seed (mulberry32), and normal ones by Box and Muller
function drawer(seed) {
  let state = seed;
  const uniform = () => {
    state = (state + 0x6d2b79f5) | 0;
    let x = Math.imul(state ^ (state >>> 15), 1 | state);
    x = (x + Math.imul(x ^ (x >>> 7), 61 | x)) ^ x;
    return ((x ^ (x >>> 14)) >>> 0) / 2 ** 32;
  };
  return { uniform, normal: () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform()) };
}

// scatter grey, round, half-transparent Gaussians where the scene is: nothing else is known of it
function start(n, { uniform, normal }) {
  const low = [-1.5, -1, -1.5], high = [1.5, 0.05, 1.5];
  return {
    means: Float64Array.from({ length: 3 * n }, (_, at) => low[at % 3] + (high[at % 3] - low[at % 3]) * uniform()),
    quats: Float64Array.from({ length: 4 * n }, normal),
    scales: new Float64Array(3 * n).fill(Math.log(0.12)),
    opacities: new Float64Array(n).fill(-1),
    sh0: new Float64Array(3 * n),
  };
}
