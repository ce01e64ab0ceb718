// As much of a page as the widgets need, so that node can run them: elements, sliders and buttons, and canvases that
// keep their pixels. Reads {script, doings} from its input and prints what the page then says.

const waiting = [];
class Element {
  constructor(tag) {
    Object.assign(this, { tag, attributes: {}, children: [], listeners: {}, dataset: {}, text: "", value: "", parentNode: null });
    this.style = { setProperty() {} };
    const names = new Set();
    this.classList = { add: (x) => names.add(x), remove: (x) => names.delete(x), contains: (x) => names.has(x) };
    [this.clientWidth, this.hidden, this.tabIndex, this.pixels] = [600, true, 0, null];
    this.viewBox = { baseVal: { width: 600, height: 300 } };
  }
  set textContent(text) { [this.text, this.children] = [String(text), []]; }
  get textContent() { return this.text + this.children.map((each) => each.textContent ?? each).join(""); }
  setAttribute(name, value) {
    this.attributes[name] = String(value);
    if (["width", "height", "min", "max"].includes(name)) this[name] = Number(value);
  }
  getAttribute(name) { return this.attributes[name] ?? null; }
  append(...nodes) {
    this.children.push(...nodes);
    nodes.forEach((node) => { if (node instanceof Element) node.parentNode = this; });
  }
  addEventListener(kind, act) { (this.listeners[kind] ??= []).push(act); }
  happen(kind, event = {}) { (this.listeners[kind] ?? []).forEach((act) => act({ preventDefault() {}, stopPropagation() {}, ...event })); }
  getBoundingClientRect() { return { left: 0, top: 0, width: 600, height: 300, bottom: 300 }; }
  setPointerCapture() {}
  focus() {}
  querySelector() { return this.children.find((each) => each instanceof Element && !each.disabled); }
  all() { return [this, ...this.children.flatMap((each) => (each instanceof Element ? each.all() : []))]; }
  getContext() {
    const node = this;
    return {
      createImageData: (w, h) => new ImageData(w, h),
      putImageData: (image) => { node.pixels = image; },
      fillRect() {}, setTransform() {}, drawImage() {}, fillStyle: "",
    };
  }
}
class ImageData {
  constructor(width, height) { Object.assign(this, { width, height, data: new Uint8ClampedArray(4 * width * height) }); }
}
class Image extends Element {
  constructor() { super("img"); this.complete = true; }
  set src(_) { waiting.push(() => this.happen("load")); }
}
class ResizeObserver {
  constructor(act) { this.act = act; }
  observe() { waiting.push(this.act); }
}
const root = new Element("div");
const document = {
  createElement: (tag) => new Element(tag),
  createElementNS: (_, tag) => new Element(tag),
  querySelectorAll: () => [root],
};
const [devicePixelRatio, addEventListener] = [1, () => {}];
const getComputedStyle = () => ({ getPropertyValue: () => "#336699" });
const matchMedia = () => ({ addEventListener() {} });

const { script, doings } = JSON.parse(require("fs").readFileSync(0, "utf8"));
eval(script);
const settle = () => { while (waiting.length) waiting.shift()(); };
const one = (what, wanted) => {
  const found = root.all().filter(wanted);
  if (found.length !== 1) throw new Error(`${found.length} of ${what}`);
  return found[0];
};
settle();
for (const [kind, name, value] of doings) {
  if (kind === "slide") {
    const input = one(name, (each) => each.tag === "input" && each.getAttribute("aria-label") === name);
    input.value = value;
    input.happen("input");
  } else if (kind === "press") {
    one(name, (each) => each.tag === "button" && (each.text === name || each.getAttribute("aria-label") === name)).happen("click");
  } else {
    one(name, (each) => each.getAttribute("aria-label") === name).happen("keydown", { key: value });
  }
  settle();
}
const everything = root.all();
const readings = {};
everything.forEach((each, k) => { if (each.tag === "dt") readings[each.text] = everything[k + 1].textContent; });
console.log(JSON.stringify({
  readings,
  texts: everything.filter((each) => ["text", "p", "small", "span", "h5", "button"].includes(each.tag)).map((each) => each.textContent),
  numbers: everything.filter((each) => each.attributes.class === "pw-numbers").map((each) => each.children.map((cell) => cell.children[1].textContent)),
  canvases: everything.filter((each) => each.pixels).map(({ pixels }) => ({ width: pixels.width, height: pixels.height, data: [...pixels.data] })),
}));
