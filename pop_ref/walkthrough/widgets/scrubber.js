// A scrubber over two recorded trainings of the toy, without and with the prior.

function scrubber(root) {
  const { steps, size, runs } = RECORDING;
  const names = Object.keys(runs);
  const titles = { without: "without the prior", with: "with the prior" };
  const n_bins = runs.without.opacities[0].length;
  const tallest = Math.max(...names.map((name) => Math.max(...runs[name].opacities.flat())));

  const body = kit.make(root, "div", { class: "pw-body" });
  const pair = kit.make(body, "div", { class: "pw-pair pw-wide" });
  const panels = names.map((name) => panel(name));
  const seen = photograph().getContext("2d");
  const play = kit.make(body, "div", { class: "pw-play pw-wide" });
  const button = kit.button(play, "play", toggle, { "aria-label": "play" });
  const options = { label: "step of training", min: 0, max: steps.length - 1, step: 1, value: steps.length - 1, show: (at) => `${steps[at]} of ${steps[steps.length - 1]}` };
  const slider = kit.slider(play, options, () => { stop(); draw(); });
  const at = { x: (step) => 30 + (step / steps[steps.length - 1]) * (right - 30), y: (psnr) => 128 - ((psnr - 10) / 14) * 116 };
  let [right, playhead] = [0, null];
  const plot = kit.fit(kit.make(body, "div", { class: "pw-wide" }), 150, { "aria-label": "PSNR against steps" }, drawPlot);
  let timer = 0;
  const pictures = new Image();
  pictures.addEventListener("load", () => {
    seen.drawImage(pictures, steps.length * size, 0, size, size, 0, 0, size, size);
    draw();
  });
  pictures.src = `data:image/png;base64,${RECORDING.pictures}`;

  function panel(name) {
    const box = kit.make(pair, "div");
    kit.make(box, "h5", {}, titles[name]);
    const canvas = image(box, `the render ${titles[name]}`);
    const bars = { node: null, columns: [], width: 0 };
    const about = { style: "width:100%;display:block;margin-top:10px" };
    bars.node = kit.fit(box, 112, about, (width) => { drawBars(bars, width, name); draw(); });
    const reading = kit.readings(box);
    const told = { psnr: reading("PSNR"), n: reading("Gaussians"), faint: reading("under 0.05"), between: reading("0.05 to 0.7") };
    return { canvas, bars, told };
  }

  function image(box, label) {
    const frame = kit.make(box, "div", { class: "pw-frame" });
    return kit.make(frame, "canvas", { class: "pw-pixels", width: size, height: size, role: "img", "aria-label": label });
  }

  function photograph() {
    const box = kit.make(pair, "div", { class: "pw-aside" });
    kit.make(box, "h5", {}, "the photograph");
    const canvas = image(box, "the photograph that no step has seen");
    const cost = runs.without.psnr.at(-1) - runs.with.psnr.at(-1);
    const note = `A view that no step has seen. Both runs begin with the same Gaussians and see the same photographs; the prior's weight is ${runs.with.lambda_pop}. On this toy it costs ${kit.number(cost, 1)} dB and leaves fewer opacities undecided.`;
    kit.make(box, "p", { class: "pw-caption" }, note);
    return canvas;
  }

  function drawBars(bars, width, name) {
    const step = width / n_bins;
    bars.node.textContent = "";
    kit.svg(bars.node, "path", { d: `M0 92H${width}`, class: "pw-thin pw-soft", "stroke-width": 1 });
    ["0", "0.5", "1"].forEach((text, i) => {
      kit.svg(bars.node, "text", { x: (width * i) / 2, y: 107, "text-anchor": ["start", "middle", "end"][i] }, text);
    });
    kit.svg(bars.node, "text", { x: width, y: 12, "text-anchor": "end" }, "Gaussians by opacity");
    const style = { width: step - 1.5, rx: 1.5, class: name === "with" ? "pw-fill2" : "pw-fill1" };
    bars.columns = Array.from({ length: n_bins }, (_, i) => kit.svg(bars.node, "rect", { x: i * step + 0.75, ...style }));
  }

  function drawPlot(width) {
    right = width - 118;
    plot.textContent = "";
    for (const psnr of [10, 15, 20]) {
      kit.svg(plot, "path", { d: `M30 ${at.y(psnr)}H${right}`, class: "pw-thin pw-rule", "stroke-width": 1 });
      kit.svg(plot, "text", { x: 24, y: at.y(psnr) + 4, "text-anchor": "end" }, String(psnr));
    }
    for (const step of [0, 100, 200, 300, 400, 500]) {
      kit.svg(plot, "text", { x: at.x(step), y: 145, "text-anchor": "middle" }, String(step));
    }
    kit.svg(plot, "text", { x: 36, y: 12, class: "pw-strong" }, "PSNR of the unseen view, dB");
    const ends = names.map((name) => at.y(runs[name].psnr[steps.length - 1]));
    names.forEach((name, i) => {
      const d = runs[name].psnr.map((psnr, j) => `${j ? "L" : "M"}${at.x(steps[j])} ${at.y(psnr)}`).join("");
      kit.svg(plot, "path", { d, class: `pw-thin pw-${i + 1}`, "stroke-width": 2 });
      const y = ends[i] + (ends[i] < ends[1 - i] ? -3 : 12);
      kit.svg(plot, "text", { x: right + 8, y, style: `fill:var(--w-c${i + 1})` }, titles[name]);
    });
    playhead = kit.svg(plot, "path", { class: "pw-thin pw-ink", "stroke-width": 1.4 });
    draw();
  }

  function draw() {
    if (!slider || !pictures.complete) return;
    const now = Number(slider.input.value);
    names.forEach((name, row) => {
      const { canvas, bars, told } = panels[row];
      const pixels = canvas.getContext("2d");
      pixels.drawImage(pictures, now * size, row * size, size, size, 0, 0, size, size);
      const counts = runs[name].opacities[now];
      bars.columns.forEach((column, i) => {
        const height = 88 * Math.min(1, counts[i] / tallest);
        kit.set(column, { y: 92 - height, height });
      });
      const n = runs[name].n[now];
      const faint = counts[0];
      const between = counts.slice(1, Math.round(0.7 * n_bins)).reduce((sum, count) => sum + count, 0);
      told.psnr(`${kit.number(runs[name].psnr[now], 1)} dB`);
      told.n(String(n));
      told.faint(`${kit.number((100 * faint) / n, 0)} %`);
      told.between(`${kit.number((100 * between) / n, 0)} %`);
      bars.node.setAttribute("aria-label", `Gaussians by opacity, twenty bins from 0 to 1: ${counts.join(", ")}`);
    });
    if (playhead) playhead.setAttribute("d", `M${at.x(steps[now])} 18V128`);
  }

  function stop() {
    clearInterval(timer);
    timer = 0;
    button.textContent = "play";
    button.setAttribute("aria-label", "play");
  }

  function toggle() {
    if (timer) {
      stop();
      return;
    }
    if (Number(slider.input.value) === steps.length - 1) slider.set(0);
    button.textContent = "pause";
    button.setAttribute("aria-label", "pause");
    draw();
    timer = setInterval(() => {
      slider.set(Number(slider.input.value) + 1);
      draw();
      if (Number(slider.input.value) === steps.length - 1) stop();
    }, 320);
  }
}
