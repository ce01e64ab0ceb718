"use strict";
// an answer to a prediction opens once a guess has been written
for (const asked of document.querySelectorAll(".asked")) {
  const guess = asked.querySelector(".guess"), input = guess.querySelector("input");
  const status = guess.querySelector("span"), details = asked.querySelector("details");
  guess.hidden = false;
  details.querySelector("summary").addEventListener("click", (event) => {
    if (input.value.trim() || details.open) return;
    event.preventDefault();
    status.textContent = " Write a guess first; a wrong one teaches more than none.";
    input.focus();
  });
  input.addEventListener("input", () => { status.textContent = ""; });
  input.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && input.value.trim()) details.open = true;
  });
}
// an address that ends in #passed=alpha,tiles, as `pop learn check` prints it, names the stages that the reader has
// passed: their functions stand open, and what leads to other pages takes the names along
const showPassed = () => {
  const passed = (location.hash.match(/^#passed=([\w,]+)$/) ?? ["", ""])[1].split(",");
  for (const yours of document.querySelectorAll("details.yours")) {
    if (passed.includes(yours.dataset.stage)) yours.open = true;
  }
  for (const link of passed[0] ? document.querySelectorAll('a[href$=".html"]') : []) {
    link.hash = `passed=${passed.join(",")}`;
  }
};
addEventListener("hashchange", showPassed);
showPassed();
// a function of another stage opens at the second click, and stays open to who has opened it once
for (const yours of document.querySelectorAll("details.yours")) {
  const summary = yours.querySelector("summary"), status = summary.querySelector("span");
  let asked = false;
  summary.addEventListener("click", (event) => {
    if (!asked && !yours.open) {
      event.preventDefault();
      status.textContent = status.dataset.first;
    } else {
      status.textContent = "";
    }
    asked = true;
  });
}
// a strip of frames becomes one frame, a slider and a button
for (const film of document.querySelectorAll(".film")) {
  const frames = [...film.querySelectorAll("li")], controls = film.querySelector("p");
  const slider = controls.querySelector("input"), button = controls.querySelector("button");
  const output = controls.querySelector("output");
  let timer = 0;
  const show = () => {
    frames.forEach((frame, k) => { frame.hidden = k !== Number(slider.value); });
    output.textContent = frames[slider.value].textContent;
  };
  const stop = () => { clearInterval(timer); timer = 0; button.textContent = "Play"; };
  button.addEventListener("click", () => {
    if (timer) return stop();
    if (slider.value === slider.max) slider.value = 0;
    button.textContent = "Pause";
    timer = setInterval(() => {
      slider.value = Number(slider.value) + 1;
      show();
      if (slider.value === slider.max) stop();
    }, 220);
  });
  slider.addEventListener("input", () => { stop(); show(); });
  film.classList.add("plays");
  controls.hidden = false;
  slider.value = slider.max;
  show();
}
