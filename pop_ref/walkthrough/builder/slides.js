// Slides that turn: arrow keys, Space, Home and End, a swipe, the two buttons; N shows the notes, F fills the screen.
(() => {
  const slides = [...document.querySelectorAll(".slide")];
  const [bar, body] = [document.querySelector(".bar"), document.body];
  const noted = bar.querySelector("[data-notes]");
  let here = 0;

  // what is too large for its slide is made smaller: a widget as a whole, text down to three fifths
  const fit = () => {
    const face = slides[here].querySelector(".face");
    const [room, widget] = [face.querySelector(".body"), face.querySelector(".pop-widget")];
    const over = () => face.scrollHeight > face.clientHeight + 1;
    face.style.fontSize = "";
    if (widget) {
      widget.style.zoom = "";
      // on a phone it is scrolled rather than made too small to touch
      widget.style.zoom = Math.min(1, Math.max(0.62, (0.98 * room.clientHeight) / widget.offsetHeight));
    }
    const size = parseFloat(getComputedStyle(face).fontSize);
    for (let share = 1; share >= 0.6 && over(); share -= 0.05) face.style.fontSize = `${share * size}px`;
    face.style.overflow = over() ? "auto" : "";
  };
  // a widget that has just come into sight is drawn before it is measured
  const settle = () => { fit(); requestAnimationFrame(() => requestAnimationFrame(fit)); };
  const go = (to, named = true) => {
    here = Math.min(Math.max(to, 0), slides.length - 1);
    slides.forEach((slide, i) => slide.classList.toggle("here", i === here));
    bar.querySelector("output").textContent = `${here + 1} of ${slides.length}`;
    body.style.setProperty("--done", `${(100 * (here + 1)) / slides.length}%`);
    if (named) history.replaceState(null, "", `#${here + 1}`);
    settle();
  };
  const notes = () => {
    noted.setAttribute("aria-pressed", String(body.classList.toggle("noted")));
    settle();
  };
  const busy = (node) => node.closest?.("input, button, summary, a, [tabindex], .pop-widget");

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || (busy(event.target) && event.key !== "Escape")) return;
    const steps = { ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1, ArrowLeft: -1, ArrowUp: -1, PageUp: -1 };
    if (event.key in steps) go(here + steps[event.key]);
    else if (event.key === "Home") go(0);
    else if (event.key === "End") go(slides.length - 1);
    else if (event.key === "n" || event.key === "N") notes();
    else if (event.key === "f" || event.key === "F") document.documentElement.requestFullscreen?.();
    else if (event.key === "Escape") document.activeElement.blur();
    else return;
    event.preventDefault();
  });
  bar.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.go) go(here + Number(button.dataset.go));
    else notes();
    button.blur();
  });
  let began = null;
  addEventListener("touchstart", (event) => {
    const [finger] = event.touches;
    began = event.touches.length === 1 && !busy(event.target) ? [finger.clientX, finger.clientY] : null;
  }, { passive: true });
  addEventListener("touchend", (event) => {
    if (!began) return;
    const [finger] = event.changedTouches;
    const [dx, dy] = [finger.clientX - began[0], finger.clientY - began[1]];
    if (Math.abs(dx) > 50 && Math.abs(dx) > 2 * Math.abs(dy)) go(here + (dx < 0 ? 1 : -1));
    began = null;
  });
  addEventListener("hashchange", () => go(Number(location.hash.slice(1)) - 1 || 0, false));
  addEventListener("resize", settle);

  body.classList.add("turning");
  go(Number(location.hash.slice(1)) - 1 || 0, false);
})();
