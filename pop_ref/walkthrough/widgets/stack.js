// A stack of splats at one pixel: transmittance, weights, the stop, and the gradients with respect to each alpha.

function stack(root) {
  const colors = [[0.85, 0.27, 0.2], [0.95, 0.72, 0.2], [0.24, 0.62, 0.38], [0.2, 0.47, 0.85], [0.55, 0.33, 0.75]];
  const names = ["red", "yellow", "green", "blue", "violet"];
  const targets = { white: [1, 1, 1], orange: [0.95, 0.55, 0.2], blue: [0.2, 0.4, 0.8], black: [0, 0, 0] };
  const background = [0.93, 0.92, 0.9];
  const presets = {
    haze: [0.2, 0.2, 0.2, 0.2, 0.2],
    mixed: [0.3, 0.6, 0.45, 0.8, 0.5],
    "wall in the middle": [0.15, 0.15, 1, 0.6, 0.6],
    "two walls": [0.3, 1, 1, 0.5, 0.5],
  };
  // every splat sits on the pixel's centre, so that alpha is its opacity under the ceiling
  const rows = { means2d: names.map(() => [0.5, 0.5]), conics: names.map(() => [1, 0, 1]), opacities: [...presets.mixed], colors };
  let order = [0, 1, 2, 3, 4];
  let target = targets.white;
  const [left, base, high, middle] = [48, 158, 118, 244];
  let step = 96;

  const body = kit.make(root, "div", { class: "pw-body" });
  const wide = kit.make(body, "div", { class: "pw-wide" });
  const picture = kit.fit(wide, 286, {}, (width) => {
    step = (width - left - 112) / 5;
    draw();
  });
  const drawn = kit.svg(picture, "g");
  const list = kit.make(body, "div", { class: "pw-rows pw-wide", role: "list", "aria-label": "splats, nearest first" });
  const lines = names.map((name, i) => row(name, i));
  const controls = kit.make(body, "div", { class: "pw-controls pw-wide" });
  const choosePreset = kit.choice(controls, "examples", Object.keys(presets), "mixed", (name) => {
    rows.opacities = [...presets[name]];
    order = [0, 1, 2, 3, 4];
    lines.forEach((each, i) => each.slider.set(rows.opacities[i]));
    place();
    draw();
  });
  kit.choice(controls, "the photograph shows", Object.keys(targets), "white", (name) => { target = targets[name]; draw(); });

  function row(name, i) {
    const box = kit.make(list, "div", { class: "pw-row", role: "listitem" });
    const swatch = kit.make(box, "div", { class: "pw-swatch", title: "drag to reorder", style: `background:${kit.rgb(colors[i])}` });
    const move = kit.make(box, "div", { class: "pw-move" });
    const nearer = kit.button(move, "\u25b2", () => shift(i, -1, nearer), { "aria-label": `bring ${name} nearer` });
    const farther = kit.button(move, "\u25bc", () => shift(i, 1, farther), { "aria-label": `send ${name} farther` });
    const slider = kit.slider(box, { label: `alpha of ${name}`, min: 0, max: 1, step: 0.005, value: rows.opacities[i], show: (x) => kit.number(Math.min(x, PAPER.alpha_ceiling), 3) }, (value) => { rows.opacities[i] = value; draw(); });
    const numbers = kit.make(box, "div", { class: "pw-numbers" });
    const [T, weight, slope] = ["T before", "weight", "dL/d\u03b1"].map((label) => {
      const cell = kit.make(numbers, "div");
      kit.make(cell, "small", {}, label);
      return kit.make(cell, "span");
    });
    dragRow(swatch, box, i);
    return { box, nearer, farther, slider, T, weight, slope };
  }

  function dragRow(grip, box, i) {
    grip.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      grip.setPointerCapture(event.pointerId);
      box.classList.add("pw-held");
      event.preventDefault();
    });
    grip.addEventListener("pointermove", (event) => {
      if (!box.classList.contains("pw-held")) return;
      const bounds = box.getBoundingClientRect();
      if (event.clientY < bounds.top - 4) shift(i, -1);
      if (event.clientY > bounds.bottom + 4) shift(i, 1);
    });
    for (const end of ["pointerup", "pointercancel"]) grip.addEventListener(end, () => box.classList.remove("pw-held"));
  }

  function shift(i, by, button) {
    const at = order.indexOf(i);
    if (at + by < 0 || at + by >= order.length) return;
    [order[at], order[at + by]] = [order[at + by], order[at]];
    place();
    draw();
    if (button) (button.disabled ? button.parentNode.querySelector("button:not(:disabled)") : button).focus();
  }

  function place() {
    order.forEach((i, at) => {
      lines[i].box.style.order = at;
      lines[i].nearer.disabled = at === 0;
      lines[i].farther.disabled = at === order.length - 1;
    });
  }

  function label(x, y, text, attributes = {}) {
    kit.svg(drawn, "text", { x, y, "text-anchor": "middle", ...attributes }, text);
  }

  function drawColumn(at, T, part, i, slope, largest, wins) {
    const x = left + at * step;
    const y = base - T * high;
    // the light that is left comes in; the splat takes its weight from the upper end
    kit.svg(drawn, "rect", { x, y, width: step, height: T * high, class: "pw-fillrule", opacity: 0.55 });
    kit.svg(drawn, "rect", { x: x + 1, y, width: step - 2, height: part * high, rx: 2, fill: kit.rgb(colors[i]) });
    const style = `fill:${kit.onColour(colors[i])};font-weight:600`;
    if (part > 0.1) label(x + step / 2, y + (part / 2) * high + 4, kit.number(part), { style });
    if (wins) label(x + 3, y - 5, "dominates", { class: "pw-strong", "text-anchor": "start" });
    const bar = (slope / largest) * 34;
    const place = { x: x + step / 2 - 13, y: Math.min(middle, middle - bar), width: 26, height: Math.abs(bar), rx: 2 };
    kit.svg(drawn, "rect", { ...place, class: slope > 0 ? "pw-fill2" : "pw-fill1" });
  }

  function drawFrame(pixel, stopped, loss) {
    const x = left + 5 * step;
    const top = base - high;
    kit.svg(drawn, "path", { d: `M${left} ${top}V${base}H${x}`, class: "pw-thin pw-soft", "stroke-width": 1 });
    for (const T of [0, 0.5, 1]) label(left - 7, base - T * high + 4, String(T), { "text-anchor": "end" });
    label(left, 13, "light left for each splat, T, and its weight", { "text-anchor": "start", class: "pw-strong" });
    const behind = { x: x + 1, y: base - pixel.T_final * high, width: 44, height: pixel.T_final * high, rx: 2 };
    kit.svg(drawn, "rect", { ...behind, fill: kit.rgb(background), stroke: "var(--w-rule)" });
    label(x + 23, base + 15, "behind");
    kit.svg(drawn, "path", { d: `M${left} ${middle}H${x}`, class: "pw-thin pw-soft", "stroke-width": 1 });
    label(left - 7, middle - 14, "less \u03b1", { "text-anchor": "end" });
    label(left - 7, middle + 22, "more \u03b1", { "text-anchor": "end" });
    label(left, 200, "a step of descent moves \u03b1 against dL/d\u03b1", { "text-anchor": "start", class: "pw-strong" });
    kit.svg(drawn, "rect", { x: x + 62, y: top, width: 46, height: high / 2, fill: kit.rgb(pixel.color) });
    kit.svg(drawn, "rect", { x: x + 62, y: top + high / 2, width: 46, height: high / 2, fill: kit.rgb(target) });
    kit.svg(drawn, "rect", { x: x + 62, y: top, width: 46, height: high, rx: 4, class: "pw-thin pw-rule" });
    label(x + 108, top - 6, "pixel", { "text-anchor": "end" });
    label(x + 108, base + 15, "photo", { "text-anchor": "end" });
    label(x + 108, middle + 4, `L = ${kit.number(loss, 3)}`, { "text-anchor": "end", class: "pw-strong" });
    if (stopped >= 0) {
      const at = left + stopped * step;
      kit.svg(drawn, "path", { d: `M${at} ${top - 6}V${base}`, class: "pw-thin pw-2", "stroke-width": 2 });
      label(at + 7, base - 50, "stop: T would", { "text-anchor": "start", style: "fill:var(--w-c2)" });
      label(at + 7, base - 36, "fall under 1e\u22124", { "text-anchor": "start", style: "fill:var(--w-c2)" });
    }
  }

  function draw() {
    const pixel = composite_pixel(order, rows, 0.5, 0.5, background);
    const v_color = pixel.color.map((c, k) => c - target[k]);
    const loss = 0.5 * v_color.reduce((sum, g) => sum + g * g, 0);
    const { v_alphas } = composite_pixel_vjp(pixel, rows, 0.5, 0.5, background, v_color, 0);
    const winner = dominant_id(pixel.ids, pixel.weights);
    const largest = Math.max(...v_alphas.map(Math.abs), 1e-12);
    // a traversed splat that is not blended is under the floor, or the one that ends the pixel
    const last = order[pixel.n_traversed - 1];
    const ends = !pixel.ids.includes(last) && !alpha_from_sigma(0, rows.opacities[last])[1];
    const stopped = ends ? pixel.n_traversed - 1 : -1;
    drawn.textContent = "";
    order.forEach((i, at) => {
      const found = pixel.ids.indexOf(i);
      const T = found < 0 ? null : pixel.transmittances[found];
      if (found >= 0) drawColumn(at, T, pixel.weights[found], i, v_alphas[i], largest, i === winner);
      lines[i].box.dataset.dim = String(found < 0);
      lines[i].T.textContent = found < 0 ? "\u2013" : kit.small(T);
      lines[i].weight.textContent = found < 0 ? "\u2013" : kit.small(pixel.weights[found]);
      lines[i].slope.textContent = found < 0 ? "\u2013" : kit.small(v_alphas[i]);
    });
    drawFrame(pixel, stopped, loss);
    const shares = order.map((i) => `${names[i]} ${kit.number(pixel.weights[pixel.ids.indexOf(i)] ?? 0)}`).join(", ");
    picture.setAttribute("aria-label", `weights, nearest first: ${shares}; light left ${kit.small(pixel.T_final)}`);
  }

  kit.onTheme(draw);
  choosePreset("mixed");
}
