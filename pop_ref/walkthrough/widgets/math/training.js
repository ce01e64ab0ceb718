// A whole training of the toy, as pop_ref/learn/splat.py has it: forward, backward, Adam, clone, split, prune.
//
// A scene is an object of Float64Arrays: means 3, quats 4, scales 3 (logarithms), opacities 1 (logits) and sh0 3 numbers
// a Gaussian. A camera is { R, t, f, c, size }: world to camera, then focal lengths, middle and size in pixels. A matrix
// is an array of its rows, one behind the other. `v_x` is the gradient of the loss with respect to x.

const SH_C0 = 0.28209479177387814;
const WIDTHS = { means: 3, quats: 4, scales: 3, opacities: 1, sh0: 3 };
const GROW_SCALE3D = 0.01, SPLIT_SHRINK = 1.6, SCENE_SCALE = 3;

// a [n, k] times b [k, m]
function mul(a, b, n, k, m) {
  const c = new Array(n * m).fill(0);
  for (let i = 0; i < n; i += 1) for (let j = 0; j < m; j += 1) for (let l = 0; l < k; l += 1) c[i * m + j] += a[i * k + l] * b[l * m + j];
  return c;
}

function turned(a, n, m) {
  return Array.from({ length: n * m }, (_, at) => a[(at % n) * m + Math.floor(at / n)]);
}

function rotmat_from_quat([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

// one Gaussian's way to the screen: an ellipsoid in the world becomes an ellipse in pixels
function to_screen(params, i, { R: R_cam, t, f, c, size }) {
  const s = { sh0: params.sh0.subarray(3 * i, 3 * i + 3), radii: [0, 0], visible: false };
  const quat = params.quats.subarray(4 * i, 4 * i + 4);
  s.norm = Math.sqrt(quat.reduce((sum, q) => sum + q * q, 0));
  s.unit = Array.from(quat, (q) => q / s.norm);
  s.R = rotmat_from_quat(s.unit);
  s.scales = Array.from(params.scales.subarray(3 * i, 3 * i + 3), Math.exp);
  s.M = s.R.map((r, at) => r * s.scales[at % 3]);
  // its covariance in the camera is A A^T
  s.A = mul(R_cam, s.M, 3, 3, 3);
  const mean_cam = mul(R_cam, params.means.subarray(3 * i, 3 * i + 3), 3, 3, 1).map((x, k) => x + t[k]);
  s.depth = mean_cam[2];
  s.opacity = 1 / (1 + Math.exp(-params.opacities[i]));
  s.colors = Array.from(s.sh0, (x) => Math.max(SH_C0 * x + 0.5, 0));
  if (s.depth < PAPER.near_plane) return s;
  s.slopes = [mean_cam[0] / s.depth, mean_cam[1] / s.depth];
  s.mean2d = s.slopes.map((slope, k) => f[k] * slope + c[k]);
  s.clamped = s.slopes.map((slope, k) => {
    const margin = (PAPER.frustum_margin * size[k]) / (2 * f[k]);
    return Math.min(Math.max(slope, -c[k] / f[k] - margin), (size[k] - c[k]) / f[k] + margin);
  });
  s.J = [f[0] / s.depth, 0, (-f[0] * s.clamped[0]) / s.depth, 0, f[1] / s.depth, (-f[1] * s.clamped[1]) / s.depth];
  // and on the screen B B^T, with a little blur
  s.B = mul(s.J, s.A, 2, 3, 3);
  const [a, b, , d] = mul(s.B, turned(s.B, 2, 3), 2, 3, 2).map((x, at) => x + (at % 3 ? 0 : PAPER.eps2d));
  const det = a * d - b * b;
  s.conic = [d, -b, a].map((x) => x / (det > 0 ? det : 1));
  const reach = Math.min(PAPER.extent_sigmas, Math.sqrt(2 * Math.log(Math.max(s.opacity / PAPER.alpha_floor, 1))));
  s.radii = [a, d].map((x) => Math.ceil(reach * Math.sqrt(x)));
  const touches = (k) => s.radii[k] > 0 && s.mean2d[k] + s.radii[k] > 0 && s.mean2d[k] - s.radii[k] < size[k];
  s.visible = det > 0 && s.opacity >= PAPER.alpha_floor && touches(0) && touches(1);
  return s;
}

// what the way back needs of every pixel of every splat: falloff, alpha, transmittance; it lasts until the next render
let tape = new Float64Array(3 << 18);

// paint the splats from front to back: C = sum_i T_i alpha_i c_i + T_final background
function render(params, camera, background) {
  const [width, height] = camera.size;
  const splats = Array.from(params.opacities, (_, i) => to_screen(params, i, camera));
  const image = new Float64Array(3 * width * height), T = new Float64Array(width * height).fill(1);
  const ended = new Uint8Array(width * height), best = new Float64Array(width * height);
  const dominant_ids = new Int32Array(width * height).fill(-1);
  const order = [...splats.keys()].filter((i) => splats[i].visible).sort((i, j) => splats[i].depth - splats[j].depth);
  let at = 0;
  for (const i of order) {
    const { mean2d: [u, v], radii, conic: [A, B, C], opacity, colors } = splats[i];
    const [x0, x1] = [Math.max(0, Math.floor(u - radii[0])), Math.min(width, Math.ceil(u + radii[0]))];
    const [y0, y1] = [Math.max(0, Math.floor(v - radii[1])), Math.min(height, Math.ceil(v + radii[1]))];
    const from = at, to = from + 3 * Math.max(0, x1 - x0) * Math.max(0, y1 - y0);
    if (to > tape.length) { const longer = new Float64Array(2 * to); longer.set(tape); tape = longer; }
    for (let y = y0; y < y1; y += 1) for (let x = x0; x < x1; x += 1, at += 3) {
      const dx = u - (x + 0.5), dy = v - (y + 0.5), p = y * width + x;
      const G = Math.exp(-(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy));
      const alpha = Math.min(PAPER.alpha_ceiling, opacity * G);
      tape[at] = G;
      tape[at + 1] = 0;
      tape[at + 2] = T[p];
      if (ended[p] || !(alpha >= PAPER.alpha_floor)) continue;
      const next_T = T[p] * (1 - alpha);
      if (next_T <= PAPER.transmittance_stop) { ended[p] = 1; continue; }
      tape[at + 1] = alpha;
      const weight = T[p] * alpha;
      for (let k = 0; k < 3; k += 1) image[3 * p + k] += weight * colors[k];
      if (weight > best[p]) { best[p] = weight; dominant_ids[p] = i; }
      T[p] = next_T;
    }
    Object.assign(splats[i], { box: [x0, x1, y0, y1], from });
  }
  for (let at = 0; at < image.length; at += 1) image[at] += T[Math.floor(at / 3)] * background[at % 3];
  const dominant_counts = new Int32Array(splats.length);
  for (const i of dominant_ids) if (i >= 0) dominant_counts[i] += 1;
  return { image, T_final: T, splats, order, dominant_counts, camera, background };
}

// the tape backwards: from the gradient of the image to that of every parameter
function render_vjp(params, { splats, order, camera, background }, v_image) {
  const [width] = camera.size, grads = zeros_like(params), v_means2d = new Float64Array(2 * splats.length);
  // what the light that passes a splat brings the loss; behind all splats it shows the background
  const behind = Float64Array.from({ length: v_image.length / 3 }, (_, p) => [0, 1, 2].reduce((sum, k) => sum + v_image[3 * p + k] * background[k], 0));
  for (const i of [...order].reverse()) {
    const s = splats[i], { mean2d: [u, v], conic: [A, B, C], opacity, colors, box: [x0, x1, y0, y1], from } = s;
    const v_colors = [0, 0, 0], v_mean2d = [0, 0], v_conic = [0, 0, 0];
    let v_opacity = 0, at = from;
    for (let y = y0; y < y1; y += 1) for (let x = x0; x < x1; x += 1, at += 3) {
      const G = tape[at], alpha = tape[at + 1], T = tape[at + 2], p = y * width + x;
      if (!alpha) continue;
      let color_dot_grad = 0;
      for (let k = 0; k < 3; k += 1) {
        color_dot_grad += v_image[3 * p + k] * colors[k];
        v_colors[k] += T * alpha * v_image[3 * p + k];
      }
      // more alpha shows more of this splat and hides what is behind it: both parts count
      const v_alpha = T * (color_dot_grad - behind[p]);
      behind[p] += alpha * (color_dot_grad - behind[p]);
      if (opacity * G > PAPER.alpha_ceiling) continue;
      v_opacity += G * v_alpha;
      const dx = u - (x + 0.5), dy = v - (y + 0.5), v_sigma = -opacity * G * v_alpha;
      v_mean2d[0] += v_sigma * (A * dx + B * dy);
      v_mean2d[1] += v_sigma * (B * dx + C * dy);
      v_conic[0] += (v_sigma * dx * dx) / 2;
      v_conic[1] += v_sigma * dx * dy;
      v_conic[2] += (v_sigma * dy * dy) / 2;
    }
    v_means2d.set(v_mean2d, 2 * i);
    grads.opacities[i] = opacity * (1 - opacity) * v_opacity;
    grads.sh0.set(v_colors.map((g, k) => (SH_C0 * s.sh0[k] + 0.5 >= 0 ? SH_C0 * g : 0)), 3 * i);
    const { v_mean, v_quat, v_scales } = to_screen_vjp(s, camera, v_mean2d, v_conic);
    grads.means.set(v_mean, 3 * i);
    grads.quats.set(v_quat, 4 * i);
    grads.scales.set(v_scales, 3 * i);
  }
  return { grads, v_means2d };
}

// `to_screen` from its end to its beginning
function to_screen_vjp(s, { R: R_cam, f }, v_mean2d, [v_xx, v_xy, v_yy]) {
  // of an inverse: d(X^-1) = -X^-1 dX X^-1; the off-diagonal stands twice in the matrix and once in the conic
  const [A, B, C] = s.conic, inverse = [A, B, B, C];
  const v_covar2d = mul(mul(inverse, [v_xx, v_xy / 2, v_xy / 2, v_yy], 2, 2, 2), inverse, 2, 2, 2).map((x) => -x);
  // of B B^T with B = J A, and of A = R_cam M
  const v_B = mul(v_covar2d, s.B, 2, 2, 3).map((x) => 2 * x);
  const v_J = mul(v_B, turned(s.A, 3, 3), 2, 3, 3);
  const v_M = mul(turned(R_cam, 3, 3), mul(turned(s.J, 2, 3), v_B, 3, 2, 3), 3, 3, 3);
  // of the pinhole and its Jacobian, both functions of the slopes x/z, y/z and of the depth
  const z = s.depth, v_slopes = [0, 1].map((k) => f[k] * v_mean2d[k] - (s.slopes[k] === s.clamped[k] ? (f[k] / z) * v_J[3 * k + 2] : 0));
  let v_depth = 0;
  for (const k of [0, 1]) v_depth += -(s.slopes[k] * v_slopes[k]) / z + (f[k] * s.clamped[k] * v_J[3 * k + 2]) / z ** 2 - (f[k] * v_J[4 * k]) / z ** 2;
  const v_mean = mul([v_slopes[0] / z, v_slopes[1] / z, v_depth], R_cam, 1, 3, 3);
  // of M = R diag(scales), of the rotation, quadratic in the quaternion, and of the division by its norm
  const v_scales = s.scales.map((scale, k) => scale * (s.R[k] * v_M[k] + s.R[3 + k] * v_M[3 + k] + s.R[6 + k] * v_M[6 + k]));
  const [r00, r01, r02, r10, r11, r12, r20, r21, r22] = v_M.map((g, at) => g * s.scales[at % 3]);
  const [w, x, y, zq] = s.unit;
  const v_unit = [
    2 * (x * (r21 - r12) + y * (r02 - r20) + zq * (r10 - r01)),
    2 * (w * (r21 - r12) + y * (r01 + r10) + zq * (r02 + r20) - 2 * x * (r11 + r22)),
    2 * (w * (r02 - r20) + x * (r01 + r10) + zq * (r12 + r21) - 2 * y * (r00 + r22)),
    2 * (w * (r10 - r01) + x * (r02 + r20) + y * (r12 + r21) - 2 * zq * (r00 + r11)),
  ];
  const along = s.unit.reduce((sum, q, k) => sum + q * v_unit[k], 0);
  return { v_mean, v_quat: v_unit.map((g, k) => (g - s.unit[k] * along) / s.norm), v_scales };
}

function l2(image, target) {
  let loss = 0;
  const v_image = image.map((x, at) => { loss += (x - target[at]) ** 2; return (2 * (x - target[at])) / image.length; });
  return { loss: loss / image.length, v_image };
}

// pull opacities to 1 where a Gaussian dominates a pixel and to 0 where it dominates none
function pop_loss_vjp(dominant_counts) {
  const n_important = dominant_counts.reduce((n, count) => n + (count > 0), 0);
  return Array.from(dominant_counts, (count) => (count > 0 ? -1 / Math.max(n_important, 1) : 1 / Math.max(dominant_counts.length - n_important, 1)));
}

function zeros_like(params) {
  return Object.fromEntries(Object.entries(params).map(([name, x]) => [name, new Float64Array(x.length)]));
}

// move every parameter by about its learning rate: the mean of recent gradients over their typical size
function adam_step(params, grads, m, v, step, rates) {
  for (const [name, g] of Object.entries(grads)) for (let at = 0; at < g.length; at += 1) {
    m[name][at] += 0.1 * (g[at] - m[name][at]);
    v[name][at] = 0.999 * v[name][at] + 0.001 * g[at] * g[at];
    const size = Math.sqrt(v[name][at]) / Math.sqrt(1 - 0.999 ** step) + 1e-15;
    params[name][at] -= ((rates[name] / (1 - 0.9 ** step)) * m[name][at]) / size;
  }
}

// rows of every array: those that are kept, then those that are copied; `fresh` starts the copies at zero
function rows_of(arrays, kept, copied, fresh) {
  return Object.fromEntries(Object.entries(arrays).map(([name, x]) => {
    const width = WIDTHS[name], rows = new Float64Array(width * (kept.length + copied.length));
    kept.forEach((i, to) => rows.set(x.subarray(width * i, width * (i + 1)), width * to));
    if (!fresh) copied.forEach((i, to) => rows.set(x.subarray(width * i, width * (i + 1)), width * (kept.length + to)));
    return [name, rows];
  }));
}

// give detail to where the loss pulls hard or one Gaussian wins too many pixels; take away what nobody can see
function densify_and_prune({ params, m, v }, wanted, prune_opa, normals) {
  const all = [...wanted.keys()], largest = (i) => Math.exp(Math.max(...params.scales.subarray(3 * i, 3 * i + 3)));
  const small = (i) => largest(i) <= GROW_SCALE3D * SCENE_SCALE;
  const clone = all.filter((i) => wanted[i] && small(i)), split = all.filter((i) => wanted[i] && !small(i));
  const stay = all.filter((i) => !wanted[i] || small(i)), copied = [...clone, ...split, ...split];
  const grown = rows_of(params, stay, copied, false), moments = [m, v].map((x) => rows_of(x, stay, copied, true));
  // two smaller Gaussians for a large one, drawn from where it was
  const draws = normals(2 * 3 * split.length), first = stay.length + clone.length;
  [...split, ...split].forEach((i, at) => {
    const s = { scales: Array.from(params.scales.subarray(3 * i, 3 * i + 3), Math.exp), quat: params.quats.subarray(4 * i, 4 * i + 4) };
    const norm = Math.sqrt(s.quat.reduce((sum, q) => sum + q * q, 0));
    const offset = mul(rotmat_from_quat(Array.from(s.quat, (q) => q / norm)), s.scales.map((x, k) => x * draws[3 * at + k]), 3, 3, 1);
    for (let k = 0; k < 3; k += 1) {
      grown.means[3 * (first + at) + k] += offset[k];
      grown.scales[3 * (first + at) + k] -= Math.log(SPLIT_SHRINK);
    }
  });
  const seen = [...grown.opacities.keys()].filter((i) => 1 / (1 + Math.exp(-grown.opacities[i])) >= prune_opa);
  [params, m, v] = [grown, ...moments].map((x) => rows_of(x, seen, [], false));
  return { params, m, v };
}

function new_training(params) {
  const n = params.opacities.length;
  return { params, m: zeros_like(params), v: zeros_like(params), step: 0, grad_sum: new Float64Array(n), n_visible: new Float64Array(n), blurred: new Uint8Array(n) };
}

// One turn of the loop. `settings`: steps (in all), rates (learning rates at the first step; they fall to a tenth),
// lambda_pop, theta_blur (a share of the picture), densify_every, densify_until, grow_grad2d, prune_opa.
function training_step(state, camera, photograph, settings, normals) {
  const [width, height] = camera.size;
  const drawn = render(state.params, camera, [0, 0, 0]);
  const { loss, v_image } = l2(drawn.image, photograph);
  const { grads, v_means2d } = render_vjp(state.params, drawn, v_image);
  const pull = pop_loss_vjp(drawn.dominant_counts);
  drawn.splats.forEach((s, i) => {
    grads.opacities[i] += s.opacity * (1 - s.opacity) * settings.lambda_pop * pull[i];
    // how hard the loss pulls a splat across the screen, and whether it wins too much of this view
    if (s.visible) state.grad_sum[i] += Math.hypot((width / 2) * v_means2d[2 * i], (height / 2) * v_means2d[2 * i + 1]);
    state.n_visible[i] += s.visible;
    state.blurred[i] = drawn.dominant_counts[i] > settings.theta_blur * width * height;
  });
  state.step += 1;
  const fall = 0.1 ** Math.min(1, state.step / settings.steps);
  adam_step(state.params, grads, state.m, state.v, state.step, Object.fromEntries(Object.entries(settings.rates).map(([name, rate]) => [name, fall * rate])));
  if (state.step % settings.densify_every === 0 && state.step <= settings.densify_until) {
    const wanted = Array.from(state.grad_sum, (sum, i) => state.blurred[i] > 0 || sum / Math.max(state.n_visible[i], 1) > settings.grow_grad2d);
    const { step } = state;
    Object.assign(state, densify_and_prune(state, wanted, settings.prune_opa, normals));
    Object.assign(state, { ...new_training(state.params), m: state.m, v: state.v, step });
  }
  return loss;
}

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
