// Orbit a Gaussian: points drawn from it and sent through the pinhole, against the ellipse that splatting draws (EWA).

function orbit(root) {
  const [W, H, f, border] = [320, 240, 270, 44];
  const K = [[f, 0, W / 2], [0, f, H / 2], [0, 0, 1]];
  const quat = [0.85, 0.3, 0.1, 0.45];
  const state = { scales: [0.9, 0.35, 0.2], distance: 4, sideways: 0, azimuth: 0.6, elevation: 0.35 };
  const normals = draw_normals(1600);

  const body = kit.make(root, "div", { class: "pw-body" });
  const left = kit.make(body, "div");
  const stage = kit.make(left, "div", {
    class: "pw-stage pw-frame pw-handle", tabindex: 0, role: "application", style: "border-radius:8px",
    "aria-label": "the camera's view; drag or use the arrow keys to walk around the Gaussian",
  });
  const canvas = kit.make(stage, "canvas", { width: W + 2 * border, height: H + 2 * border, "aria-hidden": "true" });
  const over = kit.svg(stage, "svg", { class: "pw-over", viewBox: `${-border} ${-border} ${W + 2 * border} ${H + 2 * border}` });
  kit.svg(over, "rect", { width: W, height: H, class: "pw-thin pw-soft", "stroke-width": 1 });
  kit.svg(over, "text", { x: 6, y: H - 7 }, `the image, ${W} \u00d7 ${H} px`);
  const arms = [0, 1, 2].map(() => kit.svg(over, "path", { class: "pw-thin pw-ink" }));
  const ours = [1, 2, 3].map(() => kit.svg(over, "ellipse", { class: "pw-thin pw-2", "stroke-width": 2 }));
  const cloud = kit.svg(over, "ellipse", { class: "pw-thin pw-3 pw-dash", "stroke-width": 2 });
  kit.legend(left, [
    ["c2", "1, 2, 3 standard deviations by EWA"], ["c3", "middle 68 % of the projected points", true], ["ink", "the Gaussian\u2019s axes"],
  ]);

  const controls = kit.make(body, "div", { class: "pw-controls" });
  const world = (x) => `${kit.number(x)} world units`;
  const slider = (label, min, max, step, value, show, put) =>
    kit.slider(controls, { label, min, max, step, value, show }, (x) => { put(x); draw(); });
  ["first", "second", "third"].forEach((name, i) =>
    slider(`${name} scale`, 0.02, 1.5, 0.01, state.scales[i], kit.number, (x) => { state.scales[i] = x; }));
  slider("distance", 1.5, 12, 0.1, state.distance, world, (x) => { state.distance = x; });
  slider("sideways, x/z", -1, 1, 0.01, 0, kit.number, (x) => { state.sideways = x; });
  kit.make(controls, "p", { class: "pw-caption" }, "half-widths on the screen: standard deviations, and of the points the middle 68 %");
  const reading = kit.readings(controls);
  const told = {
    ewa: reading("by EWA"),
    cloud: reading("of the points"),
    sides: reading("to the long axis\u2019 two sides"),
    clamp: reading("frustum clamp (B1)"),
    J: kit.readings(controls)("J, px / unit"),
  };

  // the same normals at every visit, and evenly spread: multiples of four incommensurable numbers, by Box and Muller
  function draw_normals(n) {
    const steps = [1, 2, 3, 4].map((k) => 1.1673039782614187 ** -k);
    return Array.from({ length: n }, (_, i) => {
      const [u, v, s, t] = steps.map((step) => (0.5 + (i + 1) * step) % 1);
      const [near, far] = [u, s].map((x) => Math.sqrt(-2 * Math.log(1 - x)));
      return [near * Math.cos(2 * Math.PI * v), near * Math.sin(2 * Math.PI * v), far * Math.cos(2 * Math.PI * t)];
    });
  }

  // +x right, +y down, +z forward; the Gaussian lies at the world's origin
  function camera() {
    const [ca, sa] = [Math.cos(state.azimuth), Math.sin(state.azimuth)];
    const [ce, se] = [Math.cos(state.elevation), Math.sin(state.elevation)];
    return [
      [ca, 0, -sa, state.sideways * state.distance],
      [-sa * se, ce, -ca * se, 0],
      [sa * ce, se, ca * ce, state.distance],
      [0, 0, 0, 1],
    ];
  }

  function project_cloud(viewmat) {
    const M = rotmats_from_quats(quat).map((row) => row.map((r, j) => r * state.scales[j]));
    const points = [];
    for (const e of normals) {
      const point = M.map((row) => row[0] * e[0] + row[1] * e[1] + row[2] * e[2]);
      const point_cam = means_cam_from_means(point, viewmat);
      if (point_cam[2] > PAPER.near_plane) points.push(project_means(point_cam, K));
    }
    return points;
  }

  // how far the middle 68 % of the points reach from the centre, to either side along the ellipse's two axes; quantiles,
  // because some points land so far out that a variance says nothing
  function spread(points, mean2d, angle) {
    return [angle, angle + Math.PI / 2].map((way) => {
      const [c, s] = [Math.cos(way), Math.sin(way)];
      const along = points.map((p) => (p[0] - mean2d[0]) * c + (p[1] - mean2d[1]) * s).sort((a, b) => a - b);
      return [0.16, 0.84].map((share) => along[Math.round(share * (along.length - 1))]);
    });
  }

  function put(node, mean2d, long, short, angle, shift = [0, 0]) {
    const turn = `rotate(${(angle * 180) / Math.PI} ${mean2d[0]} ${mean2d[1]})`;
    kit.set(node, { cx: mean2d[0] + shift[0], cy: mean2d[1] + shift[1], rx: long, ry: short, transform: turn });
  }

  function drawPoints(points) {
    const sharp = Math.max(1, Math.min(3, (canvas.clientWidth * devicePixelRatio) / (W + 2 * border)));
    canvas.width = (W + 2 * border) * sharp;
    canvas.height = (H + 2 * border) * sharp;
    const pixels = canvas.getContext("2d");
    pixels.setTransform(sharp, 0, 0, sharp, border * sharp, border * sharp);
    const { c1, paper } = kit.colours(root);
    pixels.fillStyle = `rgb(${paper.join(" ")})`;
    pixels.fillRect(0, 0, W, H);
    pixels.fillStyle = `rgb(${c1.join(" ")} / 0.5)`;
    for (const [x, y] of points) pixels.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  }

  function drawArms(viewmat) {
    const R = rotmats_from_quats(quat);
    arms.forEach((node, j) => {
      const ends = [-1, 1].map((side) => means_cam_from_means(R.map((row) => side * row[j] * state.scales[j]), viewmat));
      const visible = ends.every((end) => end[2] > PAPER.near_plane);
      const [a, b] = ends.map((end) => project_means(end, K));
      node.setAttribute("d", visible ? `M${a[0]} ${a[1]}L${b[0]} ${b[1]}` : "");
    });
  }

  function draw() {
    const viewmat = camera();
    const mean_cam = means_cam_from_means([0, 0, 0], viewmat);
    const mean2d = project_means(mean_cam, K);
    const J = projection_jacobians(mean_cam, K, W, H);
    const covar_cam = covars_cam_from_covars(covars_from_quats_scales(quat, state.scales), viewmat);
    const covar2d = project_covars(covar_cam, J);
    const points = project_cloud(viewmat);
    const { long, short, angle } = kit.ellipse(covar2d);
    const seen = spread(points, mean2d, angle);
    const half = seen.map(([low, high]) => (high - low) / 2);
    const middle = seen.map(([low, high]) => (high + low) / 2);
    drawPoints(points);
    drawArms(viewmat);
    ours.forEach((node, i) => put(node, mean2d, (i + 1) * long, (i + 1) * short, angle));
    put(cloud, mean2d, half[0], half[1], angle, middle);
    told.J(J.map((line) => line.map((x) => kit.number(x, 1).padStart(6, "\u2007")).join(" ")).join("\n"));
    told.ewa(`${kit.number(long, 1)} \u00d7 ${kit.number(short, 1)} px`);
    told.cloud(`${kit.number(half[0], 1)} \u00d7 ${kit.number(half[1], 1)} px`);
    told.sides(seen[0].map((x) => kit.number(Math.abs(x), 1)).join(" and ").concat(" px"));
    told.clamp(Math.abs(J[0][2] + (f * mean_cam[0]) / mean_cam[2] ** 2) > 1e-9 ? "active" : "inactive");
  }

  function turn([dx, dy]) {
    state.azimuth += dx;
    state.elevation = kit.clamp(state.elevation + dy, -1.5, 1.5);
    draw();
  }
  let last = [0, 0];
  const walked = (at) => { turn([(at[0] - last[0]) * 0.01, (at[1] - last[1]) * 0.01]); last = at; };
  kit.drag(stage, over, walked, (at) => { last = at; });
  kit.arrows(stage, 0.08, turn);
  kit.onTheme(draw);
  new ResizeObserver(draw).observe(stage);
  draw();
}
