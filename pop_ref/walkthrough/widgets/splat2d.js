// Drag a splat: its ellipse, the alpha of every pixel, the floor of 1/255 and the extent.

function splat2d(root) {
  const [W, H] = [24, 16];
  const splat = { mean2d: [12.1, 7.4], opacity: 0.8, long: 3.4, short: 1.5, turn: 23, eps2d: 0.3, log: false };
  const probe = [17, 10];

  const body = kit.make(root, "div", { class: "pw-body" });
  const left = kit.make(body, "div");
  const stage = kit.make(left, "div", { class: "pw-stage" });
  const frame = kit.make(stage, "div", { class: "pw-frame" });
  const canvas = kit.make(frame, "canvas", { class: "pw-pixels", width: W, height: H, "aria-hidden": "true" });
  const over = kit.svg(stage, "svg", { class: "pw-over", viewBox: `0 0 ${W} ${H}`, role: "group", "aria-label": "the screen, 24 by 16 pixels" });
  kit.svg(over, "clipPath", { id: "pw-splat2d-clip" }).append(kit.svg(null, "rect", { width: W, height: H }));
  const inside = kit.svg(over, "g", { "clip-path": "url(#pw-splat2d-clip)" });
  const dots = [];
  for (let y = 0; y < H; y += 1) for (let x = 0; x < W; x += 1) dots.push(`M${x + 0.47} ${y + 0.5}h.06`);
  kit.svg(inside, "path", { d: dots.join(""), class: "pw-thin pw-soft", "stroke-width": "1", opacity: 0.55 });
  const extent = kit.svg(inside, "rect", { class: "pw-thin pw-3 pw-dash" });
  const ellipses = [1, 2, 0].map((k) => kit.svg(inside, "ellipse", { class: `pw-thin ${k ? "pw-ink" : "pw-2"}` }));
  const square = kit.svg(over, "rect", { width: 1, height: 1, class: "pw-thin pw-4", "stroke-width": 2 });
  const pick = kit.svg(over, "g", { class: "pw-handle", tabindex: 0, role: "button", "aria-label": "the pixel that is read; arrow keys choose another" });
  kit.svg(pick, "rect", { width: W, height: H, class: "pw-hit" });
  const axes = [0, 1].map(() => handle(0.32));
  const centre = handle(0.48);
  kit.set(centre, { tabindex: 0, role: "button", "aria-label": "centre of the splat; arrow keys move it" });
  kit.legend(left, [
    ["ink", "1 and 2 standard deviations"], ["c2", "alpha = 1/255"], ["c3", "extent", true], ["c4", "the pixel read"],
  ]);
  let curve = null;
  const about = { "aria-label": "alpha against distance in standard deviations", style: "width:100%;margin-top:12px;display:block" };
  const plot = kit.fit(left, 150, about, (width) => { curve = drawAxes(width); draw(); });

  const controls = kit.make(body, "div", { class: "pw-controls" });
  const px = (x) => `${kit.number(x)} px`;
  const slider = (label, key, min, max, step, show) =>
    kit.slider(controls, { label, min, max, step, value: splat[key], show }, (value) => { splat[key] = value; draw(); });
  slider("opacity", "opacity", 0, 1, 0.005, (x) => kit.number(x, 3));
  const sliders = {
    long: slider("first standard deviation", "long", 0.1, 6, 0.05, px),
    short: slider("second standard deviation", "short", 0.1, 6, 0.05, px),
    turn: slider("rotation", "turn", -90, 90, 1, (x) => `${kit.number(x, 0)}\u00b0`),
  };
  slider("blur (low-pass)", "eps2d", 0, 2, 0.05, (x) => `${kit.number(x)} px\u00b2`);
  kit.choice(controls, "shade", ["alpha", "log of alpha"], "alpha", (name) => { splat.log = name !== "alpha"; draw(); });
  const reading = kit.readings(controls);
  const told = {
    covar: reading("\u03a3 with blur, px\u00b2"),
    k: reading("edge (1/255)"),
    radii: reading("extent"),
    pixels: reading("pixels drawn"),
    paint: reading("paint after blur, 1/\u03c1"),
    rho: reading("\u03c1, antialiased mode only"),
    probe: reading("pixel read"),
    sigma: reading("its exponent \u03c3"),
    alpha: reading("its alpha"),
  };

  function handle(r) {
    const node = kit.svg(over, "g", { class: "pw-handle" });
    kit.svg(node, "circle", { r: 1.1, class: "pw-hit" });
    kit.svg(node, "circle", { r, class: "pw-dot" });
    return node;
  }

  function drawAxes(width) {
    const right = width - 10;
    plot.textContent = "";
    const at = { x: (d) => 34 + (d / 4) * (right - 34), y: (alpha) => 8 + (Math.log10(1.3 / alpha) / Math.log10(1.3 / 0.001)) * 112 };
    for (const [alpha, text] of [[1, "1"], [0.1, "0.1"], [0.01, "0.01"]]) {
      kit.svg(plot, "path", { d: `M34 ${at.y(alpha)}H${right}`, class: "pw-thin pw-rule", "stroke-width": 1 });
      kit.svg(plot, "text", { x: 28, y: at.y(alpha) + 4, "text-anchor": "end" }, text);
    }
    for (let d = 0; d <= 4; d += 1) kit.svg(plot, "text", { x: at.x(d), y: 134, "text-anchor": "middle" }, String(d));
    kit.svg(plot, "text", { x: (34 + right) / 2, y: 149, "text-anchor": "middle" }, "distance, standard deviations");
    kit.svg(plot, "text", { x: right, y: 12, "text-anchor": "end", class: "pw-strong" }, "alpha");
    kit.svg(plot, "path", { d: `M34 ${at.y(1 / 255)}H${right}`, class: "pw-thin pw-2", "stroke-width": 1 });
    kit.svg(plot, "text", { x: 38, y: at.y(1 / 255) + 11 }, "floor, 1/255");
    const shown = kit.svg(plot, "path", { class: "pw-thin pw-1", "stroke-width": 2 });
    const skipped = kit.svg(plot, "path", { class: "pw-thin pw-1 pw-dots" });
    const dot = kit.svg(plot, "circle", { r: 4, style: "fill:var(--w-c4)" });
    return { at, shown, skipped, dot };
  }

  function drawCurve(sigma, alpha) {
    if (!curve) return;
    const paths = { shown: "", skipped: "" };
    for (let d = 0; d <= 4.001; d += 0.02) {
      const [a, skip] = alpha_from_sigma((d * d) / 2, splat.opacity);
      if (a < 0.001) break;
      const which = skip ? "skipped" : "shown";
      paths[which] += `${paths[which] ? "L" : "M"}${curve.at.x(d).toFixed(1)} ${curve.at.y(a).toFixed(1)}`;
    }
    curve.shown.setAttribute("d", paths.shown);
    curve.skipped.setAttribute("d", paths.skipped);
    const d = Math.sqrt(2 * sigma);
    kit.set(curve.dot, { cx: curve.at.x(Math.min(d, 4)), cy: curve.at.y(Math.max(alpha, 0.001)), opacity: d > 4 || alpha < 0.001 ? 0 : 1 });
  }

  function covariance() {
    const [c, s] = [Math.cos((splat.turn * Math.PI) / 180), Math.sin((splat.turn * Math.PI) / 180)];
    const [l, m] = [splat.long ** 2, splat.short ** 2];
    return [[c * c * l + s * s * m, c * s * (l - m)], [c * s * (l - m), s * s * l + c * c * m]];
  }

  function drawPixels(conic) {
    const { paper, c1 } = kit.colours(root);
    const pixels = canvas.getContext("2d");
    const image = pixels.createImageData(W, H);
    let n = 0;
    for (let y = 0; y < H; y += 1) {
      for (let x = 0; x < W; x += 1) {
        const [alpha, skip] = alpha_from_sigma(sigma_at_pixel(splat.mean2d, conic, x + 0.5, y + 0.5), splat.opacity);
        if (skip) continue;
        n += 1;
        const t = splat.log ? 0.12 + 0.88 * (Math.log(alpha * 255) / Math.log(255)) : 0.06 + 0.94 * alpha;
        image.data.set([...kit.mix(paper, c1, t), 255], 4 * (y * W + x));
      }
    }
    pixels.putImageData(image, 0, 0);
    return n;
  }

  function drawOverlay(blurred, k, radii) {
    const [u, v] = splat.mean2d;
    const { long, short, angle } = kit.ellipse(blurred);
    const turn = `rotate(${(angle * 180) / Math.PI} ${u} ${v})`;
    ellipses.forEach((node, i) => {
      const times = [1, 2, k][i];
      kit.set(node, { cx: u, cy: v, rx: times * long, ry: times * short, transform: turn });
    });
    kit.set(extent, { x: u - radii[0], y: v - radii[1], width: 2 * radii[0], height: 2 * radii[1] });
    kit.set(square, { x: probe[0], y: probe[1] });
    kit.set(centre, { transform: `translate(${u} ${v})` });
    const way = (splat.turn * Math.PI) / 180;
    const ends = [[Math.cos(way), Math.sin(way), splat.long], [-Math.sin(way), Math.cos(way), splat.short]];
    axes.forEach((node, i) => {
      const length = Math.sqrt(ends[i][2] ** 2 + splat.eps2d);
      kit.set(node, { transform: `translate(${u + ends[i][0] * length} ${v + ends[i][1] * length})` });
    });
  }

  function draw() {
    const covar2d = covariance();
    const blurred = low_pass(covar2d, splat.eps2d);
    const conic = conics_from_covars2d(blurred);
    const k = reach_in_sigmas(splat.opacity);
    const radii = radii_from_covars2d(blurred, splat.opacity);
    const n = drawPixels(conic);
    drawOverlay(blurred, k, radii);
    const sigma = sigma_at_pixel(splat.mean2d, conic, probe[0] + 0.5, probe[1] + 0.5);
    const [alpha, skip] = alpha_from_sigma(sigma, splat.opacity);
    drawCurve(sigma, alpha);
    told.covar([blurred[0][0], blurred[0][1], blurred[1][1]].map((x) => kit.number(x)).join("  "));
    told.k(k ? `at ${kit.number(k)} deviations` : "nowhere");
    told.radii(`${2 * radii[0]} \u00d7 ${2 * radii[1]} px`);
    told.pixels(`${n} of ${W * H}`);
    const rho = compensations(covar2d, splat.eps2d);
    told.paint(`\u00d7 ${kit.number(1 / rho)}`);
    told.rho(kit.number(rho, 3));
    told.probe(`column ${probe[0]}, row ${probe[1]}`);
    told.sigma(kit.number(sigma, 3));
    told.alpha(skip ? `${kit.small(alpha)}, skipped` : kit.number(alpha, 4));
  }

  function moveTo([x, y]) {
    splat.mean2d = [kit.clamp(x, 0, W), kit.clamp(y, 0, H)];
    draw();
  }
  function readAt([x, y]) {
    probe[0] = kit.clamp(Math.floor(x), 0, W - 1);
    probe[1] = kit.clamp(Math.floor(y), 0, H - 1);
    draw();
  }
  function pull(i, [x, y]) {
    const [dx, dy] = [x - splat.mean2d[0], y - splat.mean2d[1]];
    const key = i ? "short" : "long";
    splat[key] = kit.clamp(Math.sqrt(Math.max(dx * dx + dy * dy - splat.eps2d, 0)), 0.1, 6);
    const degrees = (Math.atan2(dy, dx) * 180) / Math.PI - 90 * i;
    splat.turn = ((((degrees + 90) % 180) + 180) % 180) - 90;
    sliders[key].set(splat[key]);
    sliders.turn.set(splat.turn);
    draw();
  }

  kit.drag(pick, over, readAt, readAt);
  kit.arrows(pick, 1, ([dx, dy]) => readAt([probe[0] + dx, probe[1] + dy]));
  kit.drag(centre, over, moveTo);
  kit.arrows(centre, 0.25, ([dx, dy]) => moveTo([splat.mean2d[0] + dx, splat.mean2d[1] + dy]));
  axes.forEach((node, i) => kit.drag(node, over, (at) => pull(i, at)));
  kit.onTheme(draw);
  draw();
}
