// Two robots under one policy, of which the second is corrected, and what the visitor breaks.
"use strict";
(() => {
  const NAMES = ["alone", "with AFM"], COLOURS = ["#e06a10", "#3399dd"];
  // What the belief is shown as: hypotheses of the core by name, the first that fits.
  const KINDS = [
    ["nothing has changed", "#9aa5b1", /^nothing/],
    ["late, with another gain", "#b07aa1", /^gain_(delay|lag)/],
    ["late", "#7b5ea7", /^(delay|lag|changing)/],
    ["another gain", "#2a9d6f", /^(reversed|gain|line)/],
    ["joints are mixed", "#d1495b", /^(swapped|affine)/],
    ["something else", "#e3b23c", /./],
  ];
  const page = document.getElementById("try");
  const start = page.querySelector("button");
  const [said, menu, presets, joints, legend] = page.querySelectorAll(".said, .menu, .presets, .joints, .legend");
  const figures = page.querySelectorAll("figure");
  let loaded, world, faults;

  const made = (kind, settings = {}, ...children) => {
    const element = Object.assign(document.createElement(kind), settings);
    element.append(...children);
    return element;
  };

  // A robot twice, and what draws it.
  async function worldOf(name) {
    const { mujoco, ort, THREE, files } = loaded, settings = ROBOTS[name];
    const xml = new TextDecoder().decode(files[`${name}.xml`]);
    const model = new Model(mujoco, xml, settings.skip);
    const robots = NAMES.map(() => new Robot(mujoco, xml, settings));
    const policy = await Graph.load(ort, files[`${name}.onnx`]);
    const corrector = await Corrector.load(ort, files, settings.joints.length, model);
    const scenes = robots.map(({ model }, k) => {
      const canvas = made("canvas");
      figures[k].querySelector("canvas").replaceWith(canvas);
      return new Scene(THREE, canvas, name, model, COLOURS[k]);
    });
    return { name, robots, policy, corrector, scenes, steps: 0, took: 0, dt: model.dt };
  }

  async function step({ robots, policy, corrector }, k) {
    const robot = robots[k], before = robot.state, lay = robot.lying > 0;
    const { action } = await policy.run({ seen: robot.seen });
    const planned = Array.from(action, (value) => Math.max(-1, Math.min(1, value)));
    if (k === 0 || lay) {
      robot.move(planned, faults);
      if (k === 1) corrector.forget();
      return;
    }
    const begun = performance.now();
    const command = await corrector.correct(planned);
    const decided = performance.now();
    robot.move(command, faults);
    const moved = performance.now();
    if (robot.lying) corrector.forget();
    else await corrector.measure(before, command, robot.state);
    world.took = decided - begun + performance.now() - moved;
  }

  async function advance(count = 1) {
    for (let k = 0; k < count; k++) {
      await step(world, 0);
      await step(world, 1);
      world.steps += 1;
    }
  }

  function draw(share = 1) {
    world.scenes.forEach((scene, k) => {
      const { frames } = world.robots[k];
      scene.draw(frames[Math.min(frames.length - 1, Math.floor(share * frames.length))]);
    });
  }

  async function tell() {
    world.robots.forEach(({ distance, speed, falls, lying }, k) => {
      const fallen = (lying ? ", fell" : "") + (falls > 0 ? `, ${falls} ${falls > 1 ? "falls" : "fall"}` : "");
      figures[k].querySelector("figcaption").textContent =
        `${NAMES[k]}: ${distance.toFixed(0)} m, ${speed.toFixed(1)} m/s${fallen}`;
    });
    const weights = await world.corrector.belief(), actuators = faults.gains.length;
    [...joints.children].forEach((row, joint) => {
      const shares = KINDS.map(() => 0);
      world.kinds.forEach((kind, k) => (shares[kind] += weights[k * actuators + joint]));
      const [bar, words] = row.querySelectorAll(".bar, .words");
      [...bar.children].forEach((piece, kind) => (piece.style.width = `${100 * shares[kind]}%`));
      words.textContent = KINDS[shares.indexOf(Math.max(...shares))][0];
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
      "Reverse a joint": { gains: healthy().gains.with(1, -1) },
      "Reverse all": { gains: names.map(() => -1) },
      "Swap two": { swapped: [0, 1] },
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
        const pieces = KINDS.map(([, colour]) => made("i", { style: `background: ${colour}` }));
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
    const hypotheses = JSON.parse(new TextDecoder().decode(loaded.files["hypotheses.json"]));
    next.kinds = hypotheses.map((hypothesis) => KINDS.findIndex(([, , names]) => names.test(hypothesis)));
    build(name);
    world = next;
    await tell();
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
        await tell();
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
    legend.replaceChildren(...KINDS.map(([words, colour]) => made("span", {}, made("i", { style: `background: ${colour}` }), words)));
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
    await tell();
    draw();
    return world.robots.map(({ distance, speed, falls, state, sent }) => ({ distance, speed, falls, state, sent: sent.at(-1) }));
  };
})();
