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
    ["c2", "1, 2, 3 standard deviations by EWA"], ["c3", "2 of the projected points", true], ["ink", "the Gaussian\u2019s axes"],
  ]);

  const controls = kit.make(body, "div", { class: "pw-controls" });
  const world = (x) => `${kit.number(x)} world units`;
  const slider = (label, min, max, step, value, show, put) =>
    kit.slider(controls, { label, min, max, step, value, show }, (x) => { put(x); draw(); });
  ["first", "second", "third"].forEach((name, i) =>
    slider(`${name} scale`, 0.02, 1.5, 0.01, state.scales[i], kit.number, (x) => { state.scales[i] = x; }));
  slider("distance", 1.5, 12, 0.1, state.distance, world, (x) => { state.distance = x; });
  slider("sideways, x/z", -1, 1, 0.01, 0, kit.number, (x) => { state.sideways = x; });
  kit.make(controls, "p", { class: "pw-caption" }, "standard deviations on the screen");
  const reading = kit.readings(controls);
  const told = {
    ewa: reading("by EWA"),
    cloud: reading("of the points"),
    off: reading("mismatch of \u03a3"),
    clamp: reading("frustum clamp (B1)"),
    J: kit.readings(controls)("J, px / unit"),
  };

  // the same normals at every visit: a generator of 32 bits, and pairs by Box and Muller
  function draw_normals(n) {
    let seed = 7;
    const uniform = () => {
      seed = (seed + 0x6d2b79f5) | 0;
      let t = Math.imul(seed ^ (seed >>> 15), seed | 1);
      t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
      return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
    };
    const normal = () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform());
    return Array.from({ length: n }, () => [normal(), normal(), normal()]);
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

  function moments(points) {
    const n = points.length;
    const mean = [0, 1].map((k) => points.reduce((sum, p) => sum + p[k], 0) / n);
    const second = (j, k) => points.reduce((sum, p) => sum + (p[j] - mean[j]) * (p[k] - mean[k]), 0) / n;
    return { mean, covar2d: [[second(0, 0), second(0, 1)], [second(0, 1), second(1, 1)]] };
  }

  function put(node, mean2d, covar2d, times) {
    const { long, short, angle } = kit.ellipse(covar2d);
    const turn = `rotate(${(angle * 180) / Math.PI} ${mean2d[0]} ${mean2d[1]})`;
    kit.set(node, { cx: mean2d[0], cy: mean2d[1], rx: times * long, ry: times * short, transform: turn });
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
    const seen = moments(points);
    drawPoints(points);
    drawArms(viewmat);
    ours.forEach((node, i) => put(node, mean2d, covar2d, i + 1));
    put(cloud, seen.mean, seen.covar2d, 2);
    const [a, b] = [kit.ellipse(covar2d), kit.ellipse(seen.covar2d)];
    told.J(J.map((line) => line.map((x) => kit.number(x, 1).padStart(6, "\u2007")).join(" ")).join("\n"));
    told.ewa(`${kit.number(a.long, 1)} \u00d7 ${kit.number(a.short, 1)} px`);
    told.cloud(`${kit.number(b.long, 1)} \u00d7 ${kit.number(b.short, 1)} px`);
    const norm = (A) => Math.hypot(A[0][0], A[0][1], A[1][0], A[1][1]);
    const apart = seen.covar2d.map((line, i) => line.map((x, j) => covar2d[i][j] - x));
    told.off(`${kit.number((100 * norm(apart)) / norm(seen.covar2d), 0)} %`);
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
