// `splat.py` itself, in a Python that the reader asks for: nothing is loaded before the button is pressed.

function python(root) {
  const body = kit.make(root, "div", { class: "pw-body" });
  const buttons = kit.make(body, "div", { class: "pw-play pw-wide" });
  const button = kit.button(buttons, "load Python and run splat.py", () => (worker ? stop("Stopped.") : run()));
  const told = kit.make(buttons, "span", { class: "pw-label", role: "status" });
  const lines = kit.make(body, "pre", { class: "pw-wide pw-lines", hidden: "", tabindex: 0, "aria-label": "what splat.py prints" });
  const picture = kit.make(body, "img", { hidden: "", class: "pw-wide pw-pixels", alt: "splat.png: a photograph that no step sees, and the render" });
  kit.make(body, "p", { class: "pw-caption pw-wide" }, `The button fetches Pyodide (Python and NumPy for browsers) from ${new URL(PYODIDE).host}, and hands it the file pop_ref/learn/splat.py as it is. Nothing else on these pages needs a network.`);
  let worker = null;

  function run() {
    [lines.textContent, lines.hidden, picture.hidden] = ["", true, true];
    try {
      worker = new Worker(URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" })));
    } catch {
      stop(`This browser runs no workers here. From a clone: ${COMMAND}`);
      return;
    }
    [button.textContent, told.textContent] = ["stop", "Python is being loaded."];
    worker.onmessage = ({ data }) => {
      if (data.line !== undefined) {
        lines.hidden = false;
        lines.textContent += `${data.line}\n`;
        told.textContent = "splat.py is running.";
      }
      if (data.png) {
        URL.revokeObjectURL(picture.src);
        picture.src = URL.createObjectURL(new Blob([data.png], { type: "image/png" }));
        picture.hidden = false;
      }
      if (data.end) stop(data.end);
    };
    worker.onerror = ({ message }) => stop(`The worker stopped: ${message}. From a clone: ${COMMAND}`);
    worker.postMessage({ address: PYODIDE, source: SPLAT, command: COMMAND });
  }

  function stop(why) {
    worker?.terminate();
    worker = null;
    [button.textContent, told.textContent] = ["load Python and run splat.py", why];
  }
}
