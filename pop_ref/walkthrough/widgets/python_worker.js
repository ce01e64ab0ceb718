// The worker in which Pyodide runs `splat.py`: it sends each line that is printed, and the picture once it is written.

onmessage = async ({ data: { address, source, command } }) => {
  let pyodide = null, last = null;
  const picture = () => {
    if (!pyodide?.FS.analyzePath("splat.png").exists) return;
    const written = Number(pyodide.FS.stat("splat.png").mtime);
    if (written !== last) postMessage({ png: pyodide.FS.readFile("splat.png") });
    last = written;
  };
  try {
    importScripts(`${address}pyodide.js`);
    const said = (line) => { postMessage({ line }); picture(); };
    pyodide = await loadPyodide({ indexURL: address, stdout: said, stderr: said });
    await pyodide.loadPackage("numpy", { messageCallback: () => {} });
  } catch {
    postMessage({ end: `Pyodide cannot be reached at ${new URL(address).host}. From a clone: ${command}` });
    return;
  }
  try {
    pyodide.FS.writeFile("splat.py", source);
    await pyodide.runPythonAsync("import runpy; runpy.run_path('splat.py', run_name='__main__')");
    picture();
    postMessage({ end: "splat.py has ended." });
  } catch ({ message }) {
    postMessage({ end: `splat.py stopped: ${message.trim().split("\n").at(-1)}` });
  }
};
