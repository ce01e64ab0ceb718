// Two trainings of the toy, live and side by side: the same Gaussians, without and with the prior.

function train(root) {
  const [SIZE, N_BINS, STEPS] = [64, 20, 600];
  const RATES = { means: 4e-3, quats: 1e-2, scales: 1.5e-2, opacities: 5e-2, sh0: 2e-2 };
  const settings = { steps: STEPS, rates: { ...RATES }, lambda_pop: 0.01, theta_blur: 0.01, densify_every: 100, densify_until: STEPS / 2, grow_grad2d: 2e-4, prune_opa: 0.005 };
  const titles = ["without the prior", "with the prior"];
  let [seed, run, playing, waiting, queued, batch, asked] = [1, 0, false, 0, null, 1, 0];
  let [angle, shape] = [7.5, "the picture"];
  let history = [[], []];

  const body = kit.make(root, "div", { class: "pw-body" });
  const pair = kit.make(body, "div", { class: "pw-pair pw-wide" });
  const panels = titles.map(panel);
  const photo = photograph();
  const buttons = kit.make(body, "div", { class: "pw-play pw-wide" });
  const play = kit.button(buttons, "train", toggle);
  kit.button(buttons, "one step", () => { stop(); ask(1); });
  kit.button(buttons, "start again", () => restart());
  kit.button(buttons, "other Gaussians", () => { seed += 1; restart(); });
  const told = kit.make(buttons, "span", { class: "pw-label", role: "status" });
  const plot = kit.fit(kit.make(body, "div", { class: "pw-wide" }), 150, { "aria-label": "PSNR against steps" }, drawPlot);
  const sliders = kit.make(body, "div", { class: "pw-sliders pw-wide" });
  const log = { min: -4, max: -0.5, step: 0.25 };
  kit.slider(sliders, { ...log, label: "weight of the prior, \u03bb_POP", value: -2, show: (x) => kit.small(10 ** x) }, (x) => { settings.lambda_pop = 10 ** x; });
  const share = (x) => (x >= 0 ? "off" : `${kit.number(100 * 10 ** x, 1)} % of the pixels`);
  kit.slider(sliders, { label: "blurred if it wins over \u03b8", min: -3, max: 0, step: 0.25, value: -2, show: share }, (x) => { settings.theta_blur = 10 ** x; });
  for (const [label, names] of [["places", ["means"]], ["widths and rotations", ["scales", "quats"]], ["opacities", ["opacities"]], ["colours", ["sh0"]]]) {
    const show = (x) => names.map((name) => kit.small(2 ** x * RATES[name])).join(" and ");
    kit.slider(sliders, { label: `learning rate of ${label}`, min: -4, max: 4, step: 0.5, value: 0, show }, (x) => {
      for (const name of names) settings.rates[name] = 2 ** x * RATES[name];
    });
  }
  const looks = kit.make(body, "div", { class: "pw-sliders pw-wide" });
  kit.slider(looks, { label: "look from", min: 0, max: 360, step: 7.5, value: angle, show: (x) => `${kit.number(x, 1)}\u00b0` }, (x) => { angle = x; ask(0); });
  kit.choice(looks, "show", ["the picture", "the Gaussians, a third as wide, opaque"], shape, (name) => { shape = name; ask(0); });
  kit.make(body, "p", { class: "pw-caption pw-wide" }, "Both begin with the same 300 grey Gaussians, see the same photographs in the same order, and clone, split and prune after steps 100, 200 and 300. A slider acts from the next step on; learning rates fall to a tenth by the last step. PSNR, opacities and counts are those of this training, computed in this page; the view of the PSNR is one that no step sees.");

  let workers = [];
  try {
    const place = URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" }));
    workers = titles.map((_, side) => {
      // a page that is printed does not wait for a worker
      const worker = document.body.classList.contains("book") ? here() : new Worker(place);
      worker.onmessage = ({ data }) => receive(side, data);
      worker.onerror = ({ message }) => { told.textContent = `The training stopped: ${message}`; };
      return worker;
    });
    ask(0);
  } catch {
    told.textContent = "This browser runs no workers here: open the page in another, or run python -m pop_ref.learn.splat.";
    play.disabled = true;
  }

  function here() {
    const worker = {}, text = `let onmessage; ${WORKER}\nreturn onmessage;`;
    const answer = new Function("postMessage", text)((data) => worker.onmessage({ data }));
    return Object.assign(worker, { postMessage: (data) => answer({ data }) });
  }

  function panel(title) {
    const box = kit.make(pair, "div");
    kit.make(box, "h5", {}, title);
    const canvas = image(box, `the render ${title}`);
    const bars = { node: null, columns: [], latest: null };
    bars.node = kit.fit(box, 112, { style: "width:100%;display:block;margin-top:10px" }, (width) => { drawBars(bars, width, title); if (bars.latest) fill(bars); });
    const reading = kit.readings(box);
    return { canvas, bars, psnr: reading("PSNR, unseen view"), n: reading("Gaussians"), faint: reading("opacity under 0.05"), between: reading("0.05 to 0.7") };
  }

  function image(box, label) {
    const frame = kit.make(box, "div", { class: "pw-frame" });
    return kit.make(frame, "canvas", { class: "pw-pixels", width: SIZE, height: SIZE, role: "img", "aria-label": label }).getContext("2d");
  }

  function photograph() {
    const box = kit.make(pair, "div", { class: "pw-aside" });
    kit.make(box, "h5", {}, "the photograph");
    const canvas = image(box, "the photograph from here");
    kit.make(box, "p", { class: "pw-caption" }, "What a camera would see from where you look. Training has 24 such photographs, every 15 degrees.");
    return canvas;
  }

  function drawBars(bars, width, title) {
    const step = width / N_BINS;
    bars.node.textContent = "";
    kit.svg(bars.node, "path", { d: `M0 92H${width}`, class: "pw-thin pw-soft", "stroke-width": 1 });
    ["0", "0.5", "1"].forEach((text, i) => kit.svg(bars.node, "text", { x: (width * i) / 2, y: 107, "text-anchor": ["start", "middle", "end"][i] }, text));
    kit.svg(bars.node, "text", { x: width / 2, y: 12, "text-anchor": "middle" }, "Gaussians by opacity");
    const style = { width: step - 1.5, rx: 1.5, class: title === titles[1] ? "pw-fill2" : "pw-fill1" };
    bars.columns = Array.from({ length: N_BINS }, (_, i) => kit.svg(bars.node, "rect", { x: i * step + 0.75, ...style }));
  }

  function fill({ node, columns, latest }) {
    const tallest = Math.max(1, 0.4 * latest.reduce((sum, count) => sum + count, 0));
    columns.forEach((column, i) => {
      const height = 72 * Math.min(1, latest[i] / tallest);
      kit.set(column, { y: 92 - height, height });
    });
    kit.set(node, { "aria-label": `Gaussians by opacity, twenty bins from 0 to 1: ${latest.join(", ")}` });
  }

  function drawPlot(width = plot.clientWidth) {
    if (!width) return;
    const [left, right] = [30, width - 118], ends = [];
    const x = (step) => left + (step / STEPS) * (right - left), y = (psnr) => 128 - ((kit.clamp(psnr, 8, 24) - 8) / 16) * 112;
    plot.textContent = "";
    for (const psnr of [8, 12, 16, 20, 24]) {
      kit.svg(plot, "path", { d: `M${left} ${y(psnr)}H${right}`, class: "pw-thin pw-rule", "stroke-width": 1 });
      kit.svg(plot, "text", { x: left - 6, y: y(psnr) + 4, "text-anchor": "end" }, String(psnr));
    }
    for (let step = 0; step <= STEPS; step += 100) kit.svg(plot, "text", { x: x(step), y: 145, "text-anchor": "middle" }, String(step));
    kit.svg(plot, "text", { x: left + 6, y: 10, class: "pw-strong" }, "PSNR of the unseen view, dB");
    history.forEach((points, side) => {
      const d = points.map(([step, psnr], i) => `${i ? "L" : "M"}${x(step)} ${y(psnr)}`).join("");
      kit.svg(plot, "path", { d, class: `pw-thin pw-${side + 1}`, "stroke-width": 2 });
      ends.push(points.length ? y(points.at(-1)[1]) : 128);
    });
    titles.forEach((title, side) => {
      const lower = ends[side] > ends[1 - side] || (ends[side] === ends[1 - side] && side);
      kit.svg(plot, "text", { x: right + 8, y: kit.clamp(ends[side], 14, 116) + (lower ? 12 : -3), style: `fill:var(--w-c${side + 1})` }, title);
    });
  }

  function receive(side, data) {
    waiting -= 1;
    // a picture about every 60 ms, by what the last steps took
    if (asked) batch = kit.clamp(Math.round((asked * 60) / Math.max(data.took, 5)), 1, 2 * batch);
    if (data.run === run) {
      const { canvas, bars, psnr, n, faint, between } = panels[side];
      canvas.putImageData(new ImageData(data.picture, SIZE), 0, 0);
      photo.putImageData(new ImageData(data.photo, SIZE), 0, 0);
      bars.latest = data.counts;
      fill(bars);
      const percent = (first, last) => `${kit.number((100 * data.counts.slice(first, last).reduce((sum, count) => sum + count, 0)) / Math.max(data.n, 1), 0)} %`;
      psnr(`${kit.number(data.psnr, 1)} dB`);
      n(String(data.n));
      faint(percent(0, 1));
      between(percent(1, 14));
      if (data.step !== history[side].at(-1)?.[0]) history[side].push([data.step, data.psnr]);
    }
    if (waiting) return;
    told.textContent = `step ${history[0].at(-1)?.[0] ?? 0} of ${STEPS}`;
    drawPlot();
    const left = STEPS - (history[0].at(-1)?.[0] ?? 0);
    if (queued !== null) ask(queued);
    else if (playing && left > 0) requestAnimationFrame(() => { if (playing) ask(Math.min(batch, left)); });
    else stop();
  }

  // both take the same number of steps, so that they can be compared; what is asked while they work waits
  function ask(steps) {
    if (waiting) { queued = Math.max(queued ?? 0, steps); return; }
    [queued, waiting, asked] = [null, workers.length, steps];
    workers.forEach((worker, side) => {
      worker.postMessage({ run, seed, steps, angle, shape, settings: { ...settings, lambda_pop: side ? settings.lambda_pop : 0 } });
    });
  }

  function stop() {
    playing = false;
    play.textContent = "train";
  }

  function toggle() {
    if (playing) return stop();
    if ((history[0].at(-1)?.[0] ?? 0) >= STEPS) restart();
    playing = true;
    play.textContent = "pause";
    return ask(1);
  }

  function restart() {
    run += 1;
    history = [[], []];
    ask(0);
  }
}
