// Two robots under one policy, of which the second is corrected, and what the visitor breaks.
"use strict";
(() => {
  const NAMES = ["alone", "with AFM"], COLOURS = ["#e06a10", "#3399dd"];
  const page = document.getElementById("try");
  const start = page.querySelector("button");
  const [said, menu, presets, joints, legend] = page.querySelectorAll(".said, .menu, .presets, .joints, .legend");
  const figures = page.querySelectorAll("figure");
  let loaded, scenes, world, faults;

  const made = (kind, settings = {}, ...children) => {
    const element = Object.assign(document.createElement(kind), settings);
    element.append(...children);
    return element;
  };

  // A robot twice, and what draws it.
  async function worldOf(name) {
    const { mujoco, ort, files } = loaded, settings = ROBOTS[name];
    const xml = new TextDecoder().decode(files[`${name}.xml`]);
    const model = new Model(mujoco, xml, settings.skip);
    const robots = NAMES.map(() => new Robot(mujoco, xml, settings));
    const policy = await Graph.load(ort, files[`${name}.onnx`]);
    const corrector = await Corrector.load(ort, files, settings.joints.length, model);
    return { robots, policy, corrector, took: 0, dt: model.dt };
  }

  async function planned(robot, state) {
    const { action } = await world.policy.run({ seen: robot.observe(state) });
    return Array.from(action, (value) => Math.max(-1, Math.min(1, value)));
  }

  async function stepAlone(robot) {
    robot.move(await planned(robot, robot.state), faults);
  }

  async function stepCorrected(robot) {
    const { corrector } = world, before = robot.state;
    if (robot.lying) {
      await stepAlone(robot);
      if (!robot.lying) corrector.resume();
      return;
    }
    const begun = performance.now();
    const command = await corrector.correct(await planned(robot, corrector.arrival(before)));
    const decided = performance.now();
    robot.move(command, faults);
    const moved = performance.now();
    await corrector.measure(before, command, robot.state);
    world.took = decided - begun + performance.now() - moved;
  }

  async function advance(count = 1) {
    for (let k = 0; k < count; k++) {
      await stepAlone(world.robots[0]);
      await stepCorrected(world.robots[1]);
    }
  }

  function draw(share = 1) {
    scenes.forEach((scene, k) => {
      const { frames } = world.robots[k];
      scene.draw(frames[Math.min(frames.length - 1, Math.floor(share * frames.length))]);
    });
  }

  function tell() {
    world.robots.forEach(({ distance, speed, falls, lying }, k) => {
      const fallen = (lying ? ", fell" : "") + (falls > 0 ? `, ${falls} ${falls > 1 ? "falls" : "fall"}` : "");
      figures[k].querySelector("figcaption").textContent =
        `${NAMES[k]}: ${distance.toFixed(0)} m, ${speed.toFixed(1)} m/s${fallen}`;
    });
    const beliefs = world.corrector.belief;
    [...joints.children].forEach((row, joint) => {
      const { shares, words } = beliefs[joint], [bar, label] = row.querySelectorAll(".bar, .words");
      [...bar.children].forEach((piece, kind) => (piece.style.width = `${100 * shares[kind]}%`));
      label.textContent = words;
    });
  }

  // Controls.

  function show() {
    [...joints.children].forEach((row, joint) => {
      row.querySelector("input").value = faults.gains[joint];
      row.querySelector("output").value = faults.gains[joint].toFixed(1);
    });
    const [late, swapped] = menu.querySelectorAll("input, .swap");
    late.value = faults.late;
    late.nextElementSibling.value = faults.late;
    swapped.value = faults.swapped.join();
  }

  function build(name) {
    const { joints: names } = ROBOTS[name], healthy = () => ({ gains: names.map(() => 1), late: 0, swapped: [0, 0] });
    const become = (changes) => {
      faults = { ...healthy(), ...changes };
      show();
    };
    const choices = {
      "All healthy": {},
      "Reverse a joint": { gains: healthy().gains.with(4, -1) },
      "Reverse all": { gains: names.map(() => -1) },
      "Swap two": { swapped: [0, 3] },
      "All at 60 %": { gains: names.map(() => 0.6) },
      "4 steps late": { late: 4 },
    };
    presets.replaceChildren(
      ...Object.entries(choices).map(([words, changes]) => made("button", { textContent: words, onclick: () => become(changes) })),
    );
    joints.replaceChildren(
      ...names.map((joint, k) => {
        const gain = made("input", { type: "range", min: -1, max: 1, step: 0.1, ariaLabel: `gain of ${joint}` });
        gain.oninput = () => {
          faults.gains[k] = Number(gain.value);
          show();
        };
        const pieces = BELIEFS.map(({ colour }) => made("i", { style: `background: ${colour}` }));
        const bar = made("span", { className: "bar" }, ...pieces);
        return made("div", {}, made("span", { textContent: joint }), gain, made("output"), bar, made("span", { className: "words" }));
      }),
    );
    const pairs = names.flatMap((one, j) => names.slice(j + 1).map((other, k) => [`${one} and ${other}`, [j, j + 1 + k]]));
    const options = [["no joints", [0, 0]], ...pairs].map(([textContent, pair]) => made("option", { textContent, value: pair.join() }));
    const swap = made("select", { className: "swap" }, ...options);
    swap.onchange = () => (faults.swapped = swap.value.split(",").map(Number));
    const late = made("input", { type: "range", min: 0, max: 8, step: 1 });
    late.oninput = () => {
      faults.late = Number(late.value);
      show();
    };
    const robots = Object.entries(ROBOTS).map(([value, { title }]) => made("option", { value, textContent: title }));
    const choice = made("select", { className: "robot", onchange: () => choose(choice.value) }, ...robots);
    choice.value = name;
    const again = made("button", { textContent: "From the start", onclick: () => choose(name) });
    menu.replaceChildren(
      choice, again, made("label", {}, "Steps late ", late, made("output")), made("label", {}, "Swapped: ", swap),
    );
    become({});
  }

  async function choose(name) {
    const next = await worldOf(name);
    build(name);
    world = next;
    scenes.forEach((scene, k) => scene.show(name, world.robots[k].model));
    tell();
    draw();
  }

  // As fast as life, if the machine is: what is drawn is the step before.
  async function live() {
    let begun = performance.now();
    const frame = (now) => {
      draw(Math.max(0, Math.min(1, (now - begun) / (1000 * world.dt))));
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
    for (let told = 0, pace = 1; ; ) {
      const due = begun + 1000 * world.dt;
      await advance();
      if (performance.now() - told > 200) {
        tell();
        told = performance.now();
        said.textContent = `one correction: ${world.took.toFixed(0)} ms; ${pace.toFixed(1)} × as fast as life`;
      }
      await new Promise((done) => setTimeout(done, Math.max(0, due - performance.now())));
      pace += 0.05 * ((1000 * world.dt) / (performance.now() - begun) - pace);
      begun = performance.now();
    }
  }

  async function begin() {
    start.disabled = true;
    said.textContent = "loading 10 MB ...";
    loaded = await loadAll();
    scenes = COLOURS.map((colour, k) => new Scene(loaded.THREE, figures[k].querySelector("canvas"), colour));
    legend.replaceChildren(...BELIEFS.map(({ kind, colour }) => made("span", {}, made("i", { style: `background: ${colour}` }), kind)));
    await choose("half_cheetah");
    start.hidden = true;
    said.textContent = "";
    page.dataset.ready = "";
    if (!location.search.includes("still")) await live();
  }

  const failed = (error) => (said.textContent = error.message);
  start.onclick = () => begin().catch(failed);
  // For whoever looks at single steps, as tests and the film do: try.html?still
  page.advance = async (count) => {
    await advance(count);
    tell();
    draw();
    return world.robots.map(({ distance, speed, falls, state, sent }) => ({ distance, speed, falls, state, sent: sent.at(-1) }));
  };
})();
