// Sixteen harmonics: one coefficient each, a globe painted with what each camera around it sees, and what one of them sees.

function harmonics(root) {
  const channels = { "all three": [0, 1, 2], red: [0], green: [1], blue: [2] };
  const sh = Array.from({ length: 16 }, () => [0, 0, 0]);
  let chosen = channels["all three"];
  // the camera in front, in world coordinates: right, down and forward; the middle of the globe shows what it sees
  let view = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

  const body = kit.make(root, "div", { class: "pw-body" });
  const left = kit.make(body, "div");
  const stage = kit.make(left, "div", {
    class: "pw-stage pw-handle", tabindex: 0, role: "application", style: "max-width:290px;margin:0 auto",
    "aria-label": "globe of the cameras around a Gaussian; drag or use the arrow keys to turn it",
  });
  const canvas = kit.make(stage, "canvas", { width: 220, height: 220, "aria-hidden": "true" });
  const over = kit.svg(stage, "svg", { class: "pw-over", viewBox: "0 0 220 220" });
  kit.svg(over, "circle", { cx: 110, cy: 110, r: 107, class: "pw-thin pw-rule", "stroke-width": 1 });
  kit.svg(over, "circle", { cx: 110, cy: 110, r: 9, class: "pw-thin", style: "stroke:#fff;stroke-width:4;opacity:.7" });
  kit.svg(over, "circle", { cx: 110, cy: 110, r: 9, class: "pw-thin", style: "stroke:#222;stroke-width:1.6" });
  const names = ["x", "y", "z"].map((name) => kit.svg(over, "text", { "text-anchor": "middle", style: "font-weight:600" }, `d = ${name}`));

  const controls = kit.make(body, "div", { class: "pw-controls" });
  const patch = kit.make(controls, "div", { class: "pw-patch", role: "img" });
  const reading = kit.readings(controls);
  const told = { dir: reading("direction d, camera to Gaussian"), color: reading("colour that it sees, c(d)"), raw: reading("least and most on this side") };
  kit.choice(controls, "colour channel", Object.keys(channels), "all three", (name) => { chosen = channels[name]; show(); });
  const line = kit.make(controls, "div", { class: "pw-choice" });
  const presets = { "all zero": () => 0, "a highlight": highlight, random: () => 0.7 * (Math.random() + Math.random() - 1) };
  for (const [name, value] of Object.entries(presets)) {
    kit.button(line, name, () => {
      sh.forEach((row, k) => chosen.forEach((c) => { row[c] = Math.round(100 * value(k)) / 100; }));
      show();
    });
  }

  const pyramid = kit.make(body, "div", { class: "pw-pyramid pw-wide" });
  const icons = [];
  const sliders = sh.map((row, k) => {
    const degree = Math.floor(Math.sqrt(k));
    const style = `--row:${degree + 1};--column:${k - degree * degree - degree + 4}`;
    const cell = kit.make(pyramid, "div", { class: "pw-harmonic", style });
    icons.push(kit.make(cell, "canvas", { width: 60, height: 60, "aria-hidden": "true" }));
    const options = { label: `Y${subscript(k)}`, min: -1.5, max: 1.5, step: 0.01, value: 0, show: kit.number };
    return kit.slider(cell, options, (value) => {
      const by = value - shown(row);
      chosen.forEach((c) => { row[c] += by; });
      draw();
    });
  });
  sliders.forEach(({ input }, k) => input.setAttribute("aria-label", `coefficient of harmonic ${k}, degree ${Math.floor(Math.sqrt(k))}`));

  // the slider stands at the mean of the channels that it moves
  function shown(row) {
    return chosen.reduce((sum, c) => sum + row[c], 0) / chosen.length;
  }

  function subscript(k) {
    return [...String(k)].map((digit) => String.fromCharCode(0x2080 + Number(digit))).join("");
  }

  // the series of a bright spot around one direction: each harmonic's value there, fading with its degree
  function highlight(k) {
    const towards = [-0.35, 0.45, Math.sqrt(1 - 0.35 ** 2 - 0.45 ** 2)];
    return [1.1, 0.95, 0.7, 0.4][Math.floor(Math.sqrt(k))] * sh_basis(towards, 3)[k] - (k === 0 ? 0.9 : 0);
  }

  // calls back for every pixel of a globe with the direction in which a camera looks at it from outside
  function sphere(size, rotation, paint) {
    const r = size / 2 - size / 73;
    const image = new ImageData(size, size);
    for (let j = 0; j < size; j += 1) {
      for (let i = 0; i < size; i += 1) {
        const [x, y] = [(i + 0.5 - size / 2) / r, (j + 0.5 - size / 2) / r];
        const square = x * x + y * y;
        if (square > 1.04) continue;
        const z = Math.sqrt(Math.max(0, 1 - square));
        const dir = [0, 1, 2].map((k) => rotation[2][k] * z - rotation[0][k] * x - rotation[1][k] * y);
        const edge = kit.clamp((1 - Math.sqrt(square)) * r + 0.5, 0, 1);
        image.data.set([...paint(dir), 255 * edge], 4 * (j * size + i));
      }
    }
    return image;
  }

  function drawIcons() {
    const { c1, c2, paper, card } = kit.colours(root);
    const ground = kit.mix(paper, card, 0.5);
    icons.forEach((icon, k) => {
      const paint = (dir) => {
        const Y = kit.clamp(sh_basis(dir, 3)[k], -1, 1);
        return kit.mix(ground, Y > 0 ? c1 : c2, Math.abs(Y));
      };
      icon.getContext("2d").putImageData(sphere(60, view, paint), 0, 0);
    });
  }

  function draw() {
    let [least, most] = [Infinity, -Infinity];
    const paint = (dir) => {
      const color = colors_from_sh(sh, dir, 3);
      least = Math.min(least, ...color);
      most = Math.max(most, ...color);
      return color.map((c) => 255 * Math.min(c, 1));
    };
    canvas.getContext("2d").putImageData(sphere(220, view, paint), 0, 0);
    const dir = view[2];
    const color = colors_from_sh(sh, dir, 3);
    patch.style.background = kit.rgb(color);
    patch.setAttribute("aria-label", `the colour that this view sees: ${color.map((c) => kit.number(c)).join(", ")}`);
    told.dir(`(${dir.map((d) => kit.number(d)).join(", ")})`);
    told.color(color.map((c) => kit.number(c)).join("  "));
    told.raw(`${kit.number(least)} \u2026 ${kit.number(most)}`);
    names.forEach((node, k) => {
      const at = [0, 1].map((axis) => 110 - 94 * view[axis][k]);
      // above or below the ring in the middle, and as far inside the globe as the letters are wide
      if (Math.abs(at[0] - 110) < 32 && Math.abs(at[1] - 110) < 20) at[1] = at[1] < 110 ? 90 : 130;
      const room = Math.sqrt(Math.max(0, 104 ** 2 - (Math.abs(at[1] - 110) + 6) ** 2)) - 19;
      const x = 110 + Math.min(Math.max(at[0] - 110, -room), room);
      kit.set(node, { x, y: at[1] + 4, opacity: view[2][k] > -0.2 ? 0.9 : 0 });
      node.style.fill = colors_from_sh(sh, [0, 1, 2].map((j) => (j === k ? 1 : 0)), 3)[1] > 0.5 ? "#111" : "#fff";
    });
  }

  function show() {
    sliders.forEach((slider, k) => slider.set(shown(sh[k])));
    draw();
  }

  function turn([dx, dy]) {
    const spin = (a, b, angle) => {
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      [view[a], view[b]] = [view[a].map((x, k) => c * x + s * view[b][k]), view[b].map((x, k) => c * x - s * view[a][k])];
    };
    spin(0, 2, -dx);
    spin(1, 2, -dy);
    draw();
    drawIcons();
  }

  let last = [0, 0];
  const dragged = (at) => { turn([(at[0] - last[0]) / 90, (at[1] - last[1]) / 90]); last = at; };
  kit.drag(stage, over, dragged, (at) => { last = at; });
  kit.arrows(stage, 0.12, (way) => turn(way.map((w) => -w)));
  kit.onTheme(() => { draw(); drawIcons(); });
  sh.forEach((row, k) => [-0.5, 0.1, 1].forEach((base, c) => { row[c] = highlight(k) + (k === 0 ? base : 0); }));
  show();
  drawIcons();
}
