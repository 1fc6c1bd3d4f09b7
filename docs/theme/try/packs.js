// Loads the files that docs/theme/browser.py packed as scripts: a page that is opened as a file can load only scripts.
"use strict";
const PACKS = {};

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

async function unpack(name) {
  await new Promise((done, failed) => {
    const script = Object.assign(document.createElement("script"), { src: `theme/try/${name}.js`, onload: done });
    script.onerror = () => failed(Error(`this site was built without ${name}: make docs says why`));
    document.head.append(script);
  });
  const files = Object.entries(PACKS[name]).map(async ([file, text]) => [file, await inflated(text)]);
  return Object.fromEntries(await Promise.all(files));
}

const addressOf = (source) => URL.createObjectURL(new Blob([source], { type: "text/javascript" }));

async function loadAll() {
  const names = ["mujoco", "onnxruntime", "three", "robots"];
  const [simulator, runtime, drawing, files] = await Promise.all(names.map(unpack));
  const { default: start } = await import(addressOf(simulator["mujoco.js"]));
  const mujoco = await start({ wasmBinary: simulator["mujoco.wasm"], locateFile: (file) => file });
  const ort = await import(addressOf(runtime["ort.mjs"]));
  Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: runtime["ort.wasm"].buffer });
  const core = addressOf(drawing["three.core.js"]);
  const source = new TextDecoder().decode(drawing["three.module.js"]).replaceAll("./three.core.js", core);
  const THREE = await import(addressOf(source));
  return { mujoco, ort, THREE, files };
}
