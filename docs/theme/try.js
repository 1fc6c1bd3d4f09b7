// Two ground robots on a line, one corrected by the graph in try_runtime.js, which docs/theme/hooks.py makes.
"use strict";
(() => {
  const STEP = 0.2; // s
  const LIMITS = [1.0, Math.PI / 2]; // m/s, rad/s: the box for which the file was written
  const FACTOR = 2; // times as fast as life
  const SHOWN = 50; // steps
  const page = document.getElementById("try");
  const [start, again] = page.querySelectorAll("button");
  const said = page.querySelector(".said");
  const sliders = [...page.querySelectorAll("input")];
  const captions = page.querySelectorAll("figcaption");
  const robots = [...page.querySelectorAll("canvas")].map((canvas) => ({ canvas }));
  const line = (t) => [2.6 * Math.cos(t), 1.5 * Math.sin(t) + 0.4 * Math.sin(2 * t)];
  const clip = (value, most) => Math.max(-most, Math.min(most, value));
  const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
  const points = Array.from({ length: 240 }, (_, k) => line((2 * Math.PI * k) / 240));
  robots.step = 0;
  let session, memorySize, anew;

  function begin() {
    for (const robot of robots) {
      const next = points[1];
      robot.state = [...points[0], Math.atan2(next[1] - points[0][1], next[0] - points[0][0])];
      robot.at = 0; // the point of the line that it was near last
      robot.late = []; // commands under way
      robot.trail = [];
      robot.carried = false;
      robot.memory = new Float32Array(memorySize); // zeros begin a mission
    }
  }

  // Steer to a point ahead on the line, from anywhere.
  function planned(robot) {
    const [x, y, heading] = robot.state;
    const away = (k) => Math.hypot(points[k % 240][0] - x, points[k % 240][1] - y);
    for (let k = 0; k < 40; k++) if (away(robot.at + 1) < away(robot.at)) robot.at = (robot.at + 1) % 240;
    robot.distance = away(robot.at);
    const goal = points[(robot.at + 12) % 240];
    const turn = wrapped(Math.atan2(goal[1] - y, goal[0] - x) - heading);
    return [0.7 * Math.max(0.2, Math.cos(turn)), clip(1.5 * turn, LIMITS[1])];
  }

  async function corrected(robot, plan) {
    const tensor = (values) => new ort.Tensor("float32", Float32Array.from(values), [values.length]);
    const seen = robot.carried ? [NaN, NaN, NaN] : robot.state; // what somebody moved was no transition
    const given = { memory: tensor(robot.memory), observation: tensor(seen), action: tensor(plan) };
    const found = await session.run(given, ["next_memory", "executed_action"]);
    robot.memory = found.next_memory.data;
    return [...found.executed_action.data];
  }

  // What the failing motors make of a command.
  function moved(robot, command) {
    const [speed, turn, late] = sliders.map((slider) => Number(slider.value));
    robot.late.push(command);
    while (robot.late.length > late + 1) robot.late.shift();
    const arriving = robot.late.length > late ? robot.late[0] : [0, 0];
    const [v, omega] = [speed * arriving[0], turn * arriving[1]];
    const [x, y, heading] = robot.state;
    const ahead = [x + v * Math.cos(heading) * STEP, y + v * Math.sin(heading) * STEP];
    robot.state = [...ahead, wrapped(heading + omega * STEP)];
    robot.carried = Math.hypot(...ahead) > 3.6; // lost: back to the line
    if (robot.carried) robot.state = [...points[robot.at], robot.state[2]];
  }

  function draw(robot, colour) {
    const { canvas, state } = robot, pen = canvas.getContext("2d"), scale = canvas.width / 6.4;
    const place = (x, y) => [canvas.width / 2 + scale * x, canvas.height / 2 - scale * y];
    const drawn = (path, style, width) => {
      pen.beginPath();
      path.forEach(([x, y], k) => (k ? pen.lineTo(...place(x, y)) : pen.moveTo(...place(x, y))));
      Object.assign(pen, { strokeStyle: style, lineWidth: width, lineJoin: "round" });
      pen.stroke();
    };
    pen.clearRect(0, 0, canvas.width, canvas.height);
    drawn([...points, points[0]], "#8888", 22);
    drawn(robot.trail, colour, 3);
    const [x, y, heading] = state;
    const corner = ([ahead, left]) => [
      x + 0.3 * (ahead * Math.cos(heading) - left * Math.sin(heading)),
      y + 0.3 * (ahead * Math.sin(heading) + left * Math.cos(heading)),
    ];
    pen.fillStyle = colour;
    pen.beginPath();
    for (const part of [[1, 0], [-0.8, 0.65], [-0.4, 0], [-0.8, -0.65]]) pen.lineTo(...place(...corner(part)));
    pen.fill();
  }

  async function tick() {
    const begun = performance.now();
    if (anew) anew = begin();
    robots.step += 1;
    for (const [k, robot] of robots.entries()) {
      const plan = planned(robot), before = performance.now();
      const command = k ? await corrected(robot, plan) : plan;
      if (k) robots.took = performance.now() - before;
      moved(robot, command);
      robot.trail.push([...robot.state, robot.distance]);
      if (robot.trail.length > SHOWN) robot.trail.shift();
      const mean = robot.trail.reduce((sum, row) => sum + row[3], 0) / robot.trail.length;
      const [name, colour] = k ? ["with AFM", "#3399dd"] : ["alone", "#e06a10"];
      captions[k].textContent = `${name}: ${mean.toFixed(2)} m from the line`;
      Object.assign(captions[k].dataset, { distance: mean, plan, command, step: robots.step });
      draw(robot, colour);
    }
    said.textContent = `one correction: ${robots.took.toFixed(1)} ms`;
    setTimeout(tick, Math.max(0, (1000 * STEP) / FACTOR - (performance.now() - begun)));
  }

  function bytes(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  }

  // The runtime and the file come with the site, as one script, so that the page can be opened as a file, too.
  async function load() {
    start.disabled = true;
    said.textContent = "loading ...";
    await new Promise((done, failed) => {
      const script = Object.assign(document.createElement("script"), { src: "theme/try_runtime.js", onload: done });
      script.onerror = () => failed(Error("this site was built without onnxruntime-web: make docs says why"));
      document.head.append(script);
    });
    const module = new Blob([bytes(RUNTIME.module)], { type: "text/javascript" });
    Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: bytes(RUNTIME.wasm).buffer });
    ort.env.wasm.wasmPaths = { mjs: URL.createObjectURL(module) };
    session = await ort.InferenceSession.create(bytes(RUNTIME.policy), { executionProviders: ["wasm"] });
    memorySize = session.inputMetadata.find((input) => input.name === "memory").shape[0];
    begin();
    [start.hidden, again.hidden] = [true, false];
    await tick();
  }

  start.onclick = () => load().catch((error) => (said.textContent = error.message));
  again.onclick = () => (anew = true);
  for (const slider of sliders) {
    const digits = slider.step < 1 ? 1 : 0;
    slider.oninput = () => (slider.nextElementSibling.value = Number(slider.value).toFixed(digits));
  }
  begin();
  robots.forEach((robot, k) => draw(robot, k ? "#3399dd" : "#e06a10"));
})();
