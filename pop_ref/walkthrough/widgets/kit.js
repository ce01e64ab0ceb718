// What the widgets share: elements, sliders, readings, colours of the page, and pointers.

const kit = {
  make(parent, tag, attributes = {}, text = "") {
    const node = document.createElement(tag);
    return kit.finish(parent, node, attributes, text);
  },

  svg(parent, tag, attributes = {}, text = "") {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    return kit.finish(parent, node, attributes, text);
  },

  finish(parent, node, attributes, text) {
    kit.set(node, attributes);
    if (text) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  },

  set(node, attributes) {
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  },

  // a labelled range input; `show` turns its number into words
  slider(parent, { label, min, max, step, value, show }, changed) {
    const box = kit.make(parent, "label", { class: "pw-slider" });
    const line = kit.make(box, "span", { class: "pw-line" });
    kit.make(line, "span", {}, label);
    const told = kit.make(line, "output", {});
    const input = kit.make(box, "input", { type: "range", min, max, step, "aria-label": label });
    const tell = () => {
      told.textContent = show(Number(input.value));
      input.setAttribute("aria-valuetext", told.textContent);
      input.style.setProperty("--filled", `${(100 * (input.value - min)) / (max - min)}%`);
    };
    const set = (number) => { input.value = number; tell(); };
    input.addEventListener("input", () => { tell(); changed(Number(input.value)); });
    set(value);
    return { set, input, box };
  },

  readings(parent) {
    const list = kit.make(parent, "dl", { class: "pw-readings" });
    return (label) => {
      kit.make(list, "dt", {}, label);
      const value = kit.make(list, "dd");
      return (text) => { value.textContent = text; };
    };
  },

  // what the colours of lines mean: [colour of the page, text, whether dashed]
  legend(parent, lines) {
    const box = kit.make(parent, "p", { class: "pw-caption" });
    for (const [colour, text, dashed] of lines) {
      const item = kit.make(box, "span", { class: "pw-item" });
      const style = `border-top:2px ${dashed ? "dashed" : "solid"} var(--w-${colour})`;
      kit.make(item, "span", { class: "pw-key", style });
      item.append(text);
    }
  },

  button(parent, text, pressed, attributes = {}) {
    const node = kit.make(parent, "button", { type: "button", ...attributes }, text);
    node.addEventListener("click", pressed);
    return node;
  },

  // one of several, as buttons that stay down
  choice(parent, label, options, first, chosen) {
    const box = kit.make(parent, "div", { class: "pw-choice", role: "group", "aria-label": label });
    kit.make(box, "span", { class: "pw-label" }, label);
    const choose = (name) => {
      buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(options[i] === name)));
      chosen(name);
    };
    const buttons = options.map((name) => kit.button(box, name, () => choose(name)));
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(options[i] === first)));
    return choose;
  },

  // the page's colours as numbers, for canvases
  colours(root) {
    const style = getComputedStyle(root);
    const names = ["paper", "card", "ink", "soft", "rule", "c1", "c2", "c3", "c4"];
    return Object.fromEntries(names.map((name) => {
      const hex = style.getPropertyValue(`--w-${name}`).trim().replace(/^#(.)(.)(.)$/, "#$1$1$2$2$3$3");
      return [name, [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16))];
    }));
  },

  mix(from, to, t) {
    return from.map((a, k) => a + (to[k] - a) * t);
  },

  rgb(channels) {
    return `rgb(${channels.map((c) => Math.round(Math.min(Math.max(c, 0), 1) * 255)).join(" ")})`;
  },

  // an svg whose unit is a pixel of the page however wide it is, so that its text stays readable; drawn anew by `draw`
  fit(parent, height, attributes, draw) {
    const node = kit.svg(parent, "svg", { role: "img", style: "width:100%;display:block", ...attributes });
    let width = 0;
    new ResizeObserver(() => {
      if (!node.clientWidth || node.clientWidth === width) return;
      width = node.clientWidth;
      kit.set(node, { viewBox: `0 0 ${width} ${height}`, height });
      draw(width);
    }).observe(node);
    return node;
  },

  // black or white, whichever can be read on a colour
  onColour([r, g, b]) {
    return 0.3 * r + 0.59 * g + 0.11 * b > 0.62 ? "#1d1c1a" : "#fff";
  },

  onTheme(draw) {
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    addEventListener("beforeprint", draw);
    addEventListener("afterprint", draw);
  },

  // tells of where the pointer is in the units of an svg's viewBox or a canvas's own size, while it is down
  drag(node, frame, moved, started = () => {}) {
    const place = (event) => {
      const box = frame.getBoundingClientRect();
      const view = frame.viewBox ? frame.viewBox.baseVal : frame;
      return [((event.clientX - box.left) / box.width) * view.width, ((event.clientY - box.top) / box.height) * view.height];
    };
    let down = null;
    node.addEventListener("pointerdown", (event) => {
      // a second finger drags nothing, and a button that opens a menu may never come up here
      if (event.button || ![null, event.pointerId].includes(down)) return;
      down = event.pointerId;
      node.setPointerCapture(event.pointerId);
      started(place(event));
      if (node.tabIndex >= 0) node.focus({ preventScroll: true });
      event.stopPropagation();
      event.preventDefault();
    });
    const isDown = (event) => event.pointerId === down;
    node.addEventListener("pointermove", (event) => { if (isDown(event)) moved(place(event)); });
    for (const end of ["pointerup", "pointercancel"]) node.addEventListener(end, (event) => { if (isDown(event)) down = null; });
  },

  arrows(node, step, moved) {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    node.addEventListener("keydown", (event) => {
      const way = ways[event.key];
      if (!way) return;
      event.preventDefault();
      event.stopPropagation();
      moved(way.map((w) => w * step * (event.shiftKey ? 4 : 1)));
    });
  },

  // half-axes and angle of the ellipse of one standard deviation
  ellipse(covar2d) {
    const [[a, b], [, c]] = covar2d;
    const middle = (a + c) / 2;
    const apart = Math.hypot((a - c) / 2, b);
    const angle = 0.5 * Math.atan2(2 * b, a - c);
    return { long: Math.sqrt(middle + apart), short: Math.sqrt(Math.max(0, middle - apart)), angle };
  },

  clamp(x, low, high) {
    return Math.min(Math.max(x, low), high);
  },

  number(x, digits = 2) {
    return x.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1").replace("-", "\u2212");
  },

  small(x) {
    if (x === 0) return "0";
    if (Math.abs(x) >= 0.001) return kit.number(x, 4);
    const [digits, power] = x.toExponential(1).split("e");
    return `${digits.replace("-", "\u2212")}e${power.replace("+", "").replace("-", "\u2212")}`;
  },
};
