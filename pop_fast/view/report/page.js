// a line of text, as text whatever it holds, after a dot of a colour
const line = (text, color) => {
  const made = document.createElement("div");
  if (color) made.append(Object.assign(document.createElement("i"), { style: `background:${color}` }));
  made.append(text);
  return made;
};
// a crosshair for each chart: the values at the iteration nearest to the pointer
for (const figure of document.querySelectorAll("[data-chart]")) {
  const chart = JSON.parse(figure.dataset.chart);
  const [left, right, top, bottom, width, height] = chart.box;
  const svg = figure.querySelector("svg");
  const cross = document.createElementNS("http://www.w3.org/2000/svg", "path");
  cross.setAttribute("class", "cross");
  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  svg.append(cross);
  figure.append(tip);
  const nearest = (xs, x) => xs.reduce((best, v, i) => (Math.abs(v - x) < Math.abs(xs[best] - x) ? i : best), 0);
  const hide = () => { tip.hidden = true; cross.removeAttribute("d"); };
  const show = (event) => {
    const box = svg.getBoundingClientRect();
    const px = ((event.clientX - box.left) / box.width) * width;
    const wanted = ((px - left) / (width - left - right)) * chart.stop;
    const longest = chart.series.reduce((a, b) => (b.x.length > a.x.length ? b : a), { x: [] });
    if (!longest.x.length || px < left - 8) return hide();
    const step = longest.x[nearest(longest.x, wanted)];
    const at = left + ((width - left - right) * step) / chart.stop;
    cross.setAttribute("d", `M${at} ${top}V${height - bottom}`);
    tip.replaceChildren(line(`iteration ${step}`));
    for (const s of chart.series.filter((s) => s.x.length)) {
      const at = nearest(s.x, step);
      if (Math.abs(s.x[at] - step) >= 0.02 * chart.stop || s.y[at] === null) continue;
      const text = s.y[at].toLocaleString("en", { maximumSignificantDigits: 5 });
      tip.append(line(`${s.n} ${text}${chart.unit}`, s.c));
    }
    tip.hidden = false;
    const outer = figure.getBoundingClientRect();
    const x = box.left - outer.left + (at / width) * box.width;
    tip.style.top = box.top - outer.top + 0.4 * box.height + "px";
    const wished = x < outer.width / 2 ? x + 12 : x - tip.offsetWidth - 12;
    // on a phone it is wider than either half
    tip.style.left = Math.max(0, Math.min(wished, outer.width - tip.offsetWidth)) + "px";
  };
  svg.addEventListener("pointermove", show);
  svg.addEventListener("pointerdown", show);
  svg.addEventListener("pointerleave", hide);
}
// photograph against render: the line follows the slider
for (const slider of document.querySelectorAll(".slider")) {
  const input = slider.querySelector("input");
  const move = () => slider.style.setProperty("--at", `${input.value}%`);
  input.addEventListener("input", move);
  // the browser may keep where it stood when the page is loaded again
  move();
}
if (!matchMedia("(prefers-reduced-motion: reduce)").matches) {
  for (const video of document.querySelectorAll("video.orbit")) video.play().catch(() => {});
}
