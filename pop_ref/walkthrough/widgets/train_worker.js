// The worker of the page that trains: it takes as many steps as it is asked for, then sends a picture and numbers.

const [SIZE, N_VIEWS, N_START, N_BINS] = [64, 24, 300, 20];
const cameras = Array.from({ length: N_VIEWS }, (_, k) => orbit((2 * Math.PI * k) / N_VIEWS, SIZE));
const photographs = cameras.map(photograph);
// between two of the cameras: no step sees it
const unseen = orbit(Math.PI / N_VIEWS, SIZE), target = photograph(unseen);
const black = [0, 0, 0];
let state = null;

const clipped = (image) => image.map((x) => Math.min(Math.max(x, 0), 1));
const pixels = (image) => Uint8ClampedArray.from({ length: 4 * SIZE * SIZE }, (_, at) => (at % 4 === 3 ? 255 : 255 * image[3 * Math.floor(at / 4) + (at % 4)]));

// the same Gaussians, a third as wide and opaque
function bare(params) {
  return { ...params, scales: params.scales.map((x) => x - Math.log(3)), opacities: params.opacities.map(() => 4) };
}

onmessage = ({ data: { run, seed, steps, settings, angle, shape } }) => {
  if (!state || run !== state.run) state = { ...new_training(start(N_START, drawer(seed))), run };
  const began = performance.now();
  for (let k = 0; k < steps; k += 1) {
    // drawn by the step's own number, so that both trainings see the same photographs
    const draw = drawer(7919 * seed + state.step), view = Math.floor(N_VIEWS * draw.uniform());
    training_step(state, cameras[view], photographs[view], settings, (n) => Array.from({ length: n }, draw.normal));
  }
  const took = performance.now() - began;
  const camera = orbit((angle * Math.PI) / 180, SIZE), counts = new Array(N_BINS).fill(0);
  for (const x of state.params.opacities) counts[Math.min(N_BINS - 1, Math.floor(N_BINS / (1 + Math.exp(-x))))] += 1;
  postMessage({
    run, took, counts, step: state.step, n: state.params.opacities.length,
    psnr: -10 * Math.log10(l2(clipped(render(state.params, unseen, black).image), target).loss),
    picture: pixels(render(shape === "the picture" ? state.params : bare(state.params), camera, black).image),
    photo: pixels(photograph(camera)),
  });
};
