"use strict";
(async () => {
  const text = (id) => document.getElementById(id).textContent;
  const canvas = document.getElementById("view"), message = document.getElementById("message");
  const say = (words) => { message.textContent = words; message.hidden = !words; };
  const scene = JSON.parse(text("scene"));
  const hash = new URLSearchParams(location.hash.slice(1));

  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
  if (!gl) return say("This page needs WebGL 2, which this browser does not offer.");
  // sums of many layers need more than eight bits
  const deep = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");

  // ---- the splat: SPZ, version 3, in its own frame, y up

  async function unpacked() {
    const base64 = atob(text("splat").trim());
    const bytes = Uint8Array.from(base64, (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  function parsed(bytes) {
    const view = new DataView(bytes.buffer);
    const n = view.getUint32(8, true), coefficients = [0, 3, 8, 15][bytes[12]], unit = 2 ** -bytes[13];
    const sizes = [9, 1, 3, 3, 4, 3 * coefficients];
    const columns = [];
    let at = 16;
    for (const size of sizes) {
      columns.push(bytes.subarray(at, at + n * size));
      at += n * size;
    }
    return { n, coefficients, unit, columns };
  }

  function geometryOf({ n, unit, columns }) {
    const [centres, opacities, , scales, rotations] = columns;
    const words = new DataView(rotations.buffer, rotations.byteOffset, rotations.byteLength);
    const positions = new Float32Array(3 * n), geometry = new Float32Array(12 * n);
    const q = [0, 0, 0, 0];
    for (let i = 0; i < n; i++) {
      for (let k = 0; k < 3; k++) {
        const j = 9 * i + 3 * k;
        positions[3 * i + k] = (((centres[j] | (centres[j + 1] << 8) | (centres[j + 2] << 16)) << 8) >> 8) * unit;
      }
      let word = words.getUint32(4 * i, true), rest = 1;
      const largest = word >>> 30;
      for (let k = 3; k >= 0; k--) {
        if (k === largest) continue;
        const value = (word & 511) / (511 * Math.SQRT2);
        q[k] = word & 512 ? -value : value;
        rest -= value * value;
        word >>>= 10;
      }
      q[largest] = Math.sqrt(Math.max(rest, 0));
      const [x, y, z, w] = q;
      const R = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
      ];
      const s = [0, 1, 2].map((k) => Math.exp(2 * (scales[3 * i + k] / 16 - 10)));
      const covariance = (r, c) => R[3 * r] * R[3 * c] * s[0] + R[3 * r + 1] * R[3 * c + 1] * s[1] + R[3 * r + 2] * R[3 * c + 2] * s[2];
      geometry.set([
        positions[3 * i], positions[3 * i + 1], positions[3 * i + 2], opacities[i] / 255,
        covariance(0, 0), covariance(0, 1), covariance(0, 2), covariance(1, 1),
        covariance(1, 2), covariance(2, 2), 0, 0,
      ], 12 * i);
    }
    return { positions, geometry };
  }

  function colorBytes({ n, coefficients, columns }) {
    const size = 4 * Math.floor((3 * coefficients + 6) / 4), each = 3 * coefficients;
    const bytes = new Uint8Array(size * n);
    for (let i = 0; i < n; i++) {
      bytes.set(columns[2].subarray(3 * i, 3 * i + 3), size * i);
      bytes.set(columns[5].subarray(each * i, each * i + each), size * i + 3);
    }
    return { bytes, texels: size / 4 };
  }

  // ---- WebGL

  function compiled(vertex, fragment) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source.trim());
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  function uploaded(unit, data, texels, n, formats) {
    const widest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const perRow = Math.max(1, Math.min(Math.floor(widest / texels), Math.ceil(Math.sqrt(n / texels))));
    const height = Math.max(1, Math.ceil(n / perRow));
    if (height > widest) throw new Error(`This graphics card cannot hold ${n.toLocaleString()} Gaussians.`);
    const padded = new data.constructor(4 * texels * perRow * height);
    padded.set(data);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, formats[0], texels * perRow, height, 0, formats[1], formats[2], padded);
  }

  say("Unpacking ...");
  const splat = parsed(await unpacked());
  const { positions, geometry } = geometryOf(splat);
  let program, shown;
  try {
    program = compiled(text("splat-vert"), text("splat-frag"));
    shown = compiled(
      `#version 300 es
      void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`,
      `#version 300 es
      precision highp float;
      uniform highp sampler2D image;
      out vec4 result;
      void main() { result = vec4(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`);
    uploaded(0, geometry, 3, splat.n, [gl.RGBA32F, gl.RGBA, gl.FLOAT]);
    const { bytes, texels } = colorBytes(splat);
    uploaded(1, bytes, texels, splat.n, [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE]);
  } catch (error) {
    return say(String(error.message));
  }
  const at = {};
  for (const name of ["geometry", "colors", "coefficients", "viewmat", "eye", "focal", "centre", "size", "constants",
    "floorAlpha", "ceilingAlpha", "antialiased"]) at[name] = gl.getUniformLocation(program, name);
  const rows = gl.createBuffer(), target = gl.createTexture(), framebuffer = gl.createFramebuffer();
  gl.bindVertexArray(gl.createVertexArray());
  gl.bindBuffer(gl.ARRAY_BUFFER, rows);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.disable(gl.DEPTH_TEST);

  function resized(width, height) {
    canvas.width = width;
    canvas.height = height;
    if (!deep) return;
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, target);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  }

  // ---- the camera: axes as rows (right, down, forward), a point to turn about and the distance to it

  const add = (a, b, t = 1) => a.map((v, k) => v + t * b[k]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((v) => v / Math.hypot(...a));
  function turned(v, axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), across = cross(axis, v), along = dot(axis, v) * (1 - c);
    return v.map((x, k) => c * x + s * across[k] + along * axis[k]);
  }

  let camera, chosen = 0;
  function choose(index) {
    const n = scene.cameras.length;
    chosen = ((index % n) + n) % n;
    const given = scene.cameras[chosen];
    // the file's frame is half a turn about x from that of the cameras
    const axes = given.rotation.map(([x, y, z]) => [x, -y, -z]);
    const eye = [given.eye[0], -given.eye[1], -given.eye[2]];
    camera = { axes, distance: given.distance, target: add(eye, axes[2], given.distance), lens: given };
    document.getElementById("name").textContent = given.name;
    dirty();
  }
  const eyeOf = () => add(camera.target, camera.axes[2], -camera.distance);

  function lens() {
    const { fx, fy, cx, cy, width, height } = camera.lens;
    const across = canvas.width / width, down = canvas.height / height;
    // most of the photograph is seen, and all of it where the window has its shape
    const scale = Math.min(across, down) ** 0.8 * Math.max(across, down) ** 0.2;
    return {
      focal: [scale * fx, scale * fy],
      centre: [canvas.width / 2 + scale * (cx - width / 2), canvas.height / 2 + scale * (cy - height / 2)],
    };
  }

  const up = [scene.up[0], -scene.up[1], -scene.up[2]];
  function orbit(right, down) {
    // in turns too small to leap over the pole
    if (Math.abs(down) > 0.1) {
      orbit(right / 2, down / 2);
      return orbit(right / 2, down / 2);
    }
    const yawed = camera.axes.map((axis) => turned(axis, up, -right));
    const pitched = yawed.map((axis) => turned(axis, yawed[0], -down));
    // not over the pole
    const steep = Math.abs(dot(pitched[2], up));
    camera.axes = steep > 0.995 && steep > Math.abs(dot(camera.axes[2], up)) ? yawed : pitched;
    dirty();
  }
  function pan(right, down) {
    const step = camera.distance / lens().focal[0] * ratio();
    camera.target = add(add(camera.target, camera.axes[0], -right * step), camera.axes[1], -down * step);
    dirty();
  }
  function zoom(factor) {
    camera.distance = Math.min(Math.max(camera.distance * factor, 1e-3 * scene.extent), 100 * scene.extent);
    dirty();
  }

  // ---- sorting and drawing

  const worker = new Worker(URL.createObjectURL(new Blob([text("sorter")], { type: "text/javascript" })));
  worker.postMessage({ positions }, [positions.buffer]);
  let sorting = false, asked = "", sorted = "", count = 0, pending = false, frames = 0;

  function viewRow() {
    const [x, y, z] = camera.axes[2];
    return [x, y, z, -dot(camera.axes[2], eyeOf()), scene.near];
  }
  function sort() {
    const row = viewRow(), id = row.join();
    if (sorting || id === asked) return;
    sorting = true;
    asked = id;
    worker.postMessage({ row, id });
  }
  worker.onmessage = ({ data }) => {
    sorting = false;
    sorted = data.id;
    count = data.order.length;
    gl.bindBuffer(gl.ARRAY_BUFFER, rows);
    gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
    // that the graphics card is lost stays said
    if (!gl.isContextLost()) say("");
    dirty();
  };
  worker.onerror = ({ message }) => say(`The splat cannot be sorted: ${message || "this browser starts no worker"}`);

  const ratio = () => Math.min(window.devicePixelRatio || 1, 2);
  function dirty() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(draw);
  }
  function draw() {
    pending = false;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio()));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio()));
    if (canvas.width !== width || canvas.height !== height || frames === 0) resized(width, height);
    sort();
    const eye = eyeOf(), { focal, centre } = lens(), [r, d, f] = camera.axes;
    gl.bindFramebuffer(gl.FRAMEBUFFER, deep ? framebuffer : null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...scene.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    gl.uniform1i(at.geometry, 0);
    gl.uniform1i(at.colors, 1);
    gl.uniform1i(at.coefficients, splat.coefficients);
    gl.uniformMatrix4fv(at.viewmat, false, [
      r[0], d[0], f[0], 0, r[1], d[1], f[1], 0, r[2], d[2], f[2], 0, -dot(r, eye), -dot(d, eye), -dot(f, eye), 1,
    ]);
    gl.uniform3fv(at.eye, eye);
    gl.uniform2fv(at.focal, focal);
    gl.uniform2fv(at.centre, centre);
    gl.uniform2f(at.size, width, height);
    gl.uniform4f(at.constants, scene.near, scene.eps2d, scene.margin, scene.sigmas);
    gl.uniform1f(at.floorAlpha, scene.floor);
    gl.uniform1f(at.ceilingAlpha, scene.ceiling);
    gl.uniform1i(at.antialiased, scene.antialiased ? 1 : 0);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    if (deep) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.disable(gl.BLEND);
      gl.useProgram(shown);
      gl.uniform1i(gl.getUniformLocation(shown, "image"), 2);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    frames++;
    // which view is on the screen, in the order of this view's depths
    canvas.dataset.drawn = sorted === viewRow().join() ? `${chosen}` : "";
  }

  // ---- mouse, touch and keys

  const pointers = new Map();
  let pinch = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    pinch = 0;
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => { pointers.delete(event.pointerId); pinch = 0; });
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    pointers.set(event.pointerId, event);
    if (pointers.size > 1) {
      const [a, b] = [...pointers.values()];
      const apart = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (pinch > 0 && apart > 0) zoom(pinch / apart);
      pinch = apart;
      pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) pan(dx, dy);
    else orbit(dx * 0.005, dy * 0.005);
  });
  canvas.addEventListener("wheel", (event) => {
    // in the frame of a report the wheel is the report's until the picture is clicked
    if (window.parent !== window && !document.hasFocus()) return;
    event.preventDefault();
    zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.0015));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  const keys = {
    ArrowLeft: () => orbit(0.06, 0), ArrowRight: () => orbit(-0.06, 0),
    ArrowUp: () => orbit(0, 0.06), ArrowDown: () => orbit(0, -0.06),
    "+": () => zoom(0.92), "=": () => zoom(0.92), "-": () => zoom(1 / 0.92),
    w: () => pan(0, 20), s: () => pan(0, -20), a: () => pan(20, 0), d: () => pan(-20, 0),
    n: () => choose(chosen + 1), p: () => choose(chosen - 1), r: () => choose(chosen),
  };
  window.addEventListener("keydown", (event) => {
    // Caps Lock makes letters capital
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const act = !event.ctrlKey && !event.metaKey && !event.altKey && keys[key];
    if (act) {
      event.preventDefault();
      act();
    }
  });
  document.getElementById("next").onclick = () => choose(chosen + 1);
  document.getElementById("previous").onclick = () => choose(chosen - 1);
  document.getElementById("reset").onclick = () => choose(chosen);
  canvas.addEventListener("webglcontextlost", () => say("The graphics card has lost this page; load it again."));
  window.addEventListener("resize", dirty);

  document.body.classList.toggle("bare", hash.has("bare"));
  say("Sorting ...");
  const first = hash.has("camera") ? Number(hash.get("camera")) : NaN;
  choose(Number.isInteger(first) ? first : scene.first);
})().catch((error) => {
  const message = document.getElementById("message");
  message.textContent = `The splat cannot be shown: ${error.message}`;
  message.hidden = false;
});
