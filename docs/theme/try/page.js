// The page: two robots, the faults that the visitor sets, and the belief about each joint.
"use strict";
(() => {
  const VARIABLES = ["--without-afm", "--with-afm"]; // colours, of extra.css
  const RENEWED = 200; // ms between two updates of the texts
  const page = document.getElementById("try");
  const start = page.querySelector("button");
  const [said, menu, presets, joints, legend] = page.querySelectorAll(".said, .menu, .presets, .joints, .legend");
  const figures = page.querySelectorAll("figure");
  const worlds = {};
  let loaded, scenes, world, shown, busy;

  const made = (kind, settings = {}, ...children) => {
    const element = Object.assign(document.createElement(kind), settings);
    element.append(...children);
    return element;
  };
  const slider = (range, oninput) => made("input", { type: "range", ...range, oninput });
  const colours = () => BELIEFS.map(({ colour }) => made("i", { style: `background: ${colour}` }));

  // Draw a moment of the last step; all its simulation steps are stored.
  function draw(share = 1) {
    scenes.forEach((scene, k) => scene.draw(shown[k][Math.min(shown[k].length - 1, Math.floor(share * shown[k].length))]));
  }

  function tell() {
    world.robots.forEach(({ total, speed, falls }, k) => {
      const fell = ["", ", fell once"][falls] ?? `, fell ${falls} times`;
      figures[k].querySelector("output").textContent = `return ${total.toFixed(0)}, ${speed.toFixed(1)} m/s${fell}`;
    });
    const beliefs = world.corrector.belief;
    [...joints.children].forEach((row, joint) => {
      const { shares, words } = beliefs[joint], [bar, label] = row.querySelectorAll(".bar, .words");
      [...bar.children].forEach((piece, kind) => (piece.style.width = `${100 * shares[kind]}%`));
      label.textContent = words;
    });
  }

  function showFaults() {
    const { gains, late, swapped } = world.faults, [steps, pair] = menu.querySelectorAll("input, .swap");
    [...joints.children].forEach((row, joint) => {
      row.querySelector("input").value = gains[joint];
      row.querySelector("output").value = gains[joint].toFixed(1);
    });
    steps.value = steps.nextElementSibling.value = late;
    pair.value = swapped.join();
  }

  function become(changes) {
    world.become(changes);
    showFaults();
  }

  function change(changes) {
    become({ ...world.faults, ...changes });
  }

  function buildMenu(names) {
    const options = (rows) => rows.map(([value, textContent]) => made("option", { value, textContent }));
    const robots = Object.entries(ROBOTS).map(([name, { title }]) => [name, title]);
    const robot = made("select", { className: "robot", onchange: () => choose(robot.value) }, ...options(robots));
    robot.value = world.name;
    const again = made("button", { textContent: "From the start", onclick: () => choose(world.name) });
    const late = slider({ min: 0, max: 8, step: 1 }, () => change({ late: Number(late.value) }));
    const pairs = names.flatMap((one, j) => names.slice(j + 1).map((other, k) => [[j, j + 1 + k].join(), `${one}, ${other}`]));
    const swap = made("select", { className: "swap" }, ...options([["0,0", "none"], ...pairs]));
    swap.onchange = () => change({ swapped: swap.value.split(",").map(Number) });
    menu.replaceChildren(
      made("label", {}, "Robot", robot), again,
      made("label", {}, "Steps late", late, made("output")), made("label", {}, "Swapped", swap),
    );
  }

  function buildPresets(healthy) {
    const choices = {
      "All healthy": {},
      "Reverse a joint": { gains: healthy.with(3, -1) },
      "Reverse all": { gains: healthy.map(() => -1) },
      "Swap two": { swapped: [0, 3] },
      "All at 60 %": { gains: healthy.map(() => 0.6) },
      "4 steps late": { late: 4 },
    };
    const buttons = Object.entries(choices).map(([textContent, changes]) => made("button", { textContent, onclick: () => become(changes) }));
    presets.replaceChildren(...buttons);
  }

  function buildJoints(names) {
    const rows = names.map((joint, k) => {
      const gain = slider({ min: -1, max: 1, step: 0.1, ariaLabel: `gain of ${joint}` }, () => {
        change({ gains: world.faults.gains.with(k, Number(gain.value)) });
      });
      const bar = made("span", { className: "bar" }, ...colours());
      return made("div", {}, made("span", { textContent: joint }), gain, made("output"), bar, made("span", { className: "words" }));
    });
    joints.replaceChildren(...rows);
  }

  async function choose(name) {
    worlds[name] ??= await World.load(loaded, name);
    await busy; // a step of the robots that are shown now
    world = worlds[name];
    world.begin();
    shown = world.robots.map(({ frames }) => frames);
    scenes.forEach((scene, k) => scene.show(name, world.robots[k].model));
    buildMenu(ROBOTS[name].joints);
    buildPresets(world.faults.gains);
    buildJoints(ROBOTS[name].joints);
    showFaults();
    page.dataset.robot = name;
    tell();
    draw();
  }

  // In real time, if the machine is fast enough.
  async function live() {
    let begun = performance.now(), renewed = 0, pace = 1;
    const frame = (now) => {
      draw(Math.max(0, Math.min(1, (now - begun) / (1000 * world.dt))));
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
    for (;;) {
      busy = world.advance();
      await busy;
      await new Promise((done) => setTimeout(done, begun + 1000 * world.dt - performance.now()));
      shown = world.robots.map(({ frames }) => frames);
      pace += 0.05 * ((1000 * world.dt) / (performance.now() - begun) - pace);
      begun = performance.now();
      if (begun - renewed < RENEWED) continue;
      tell();
      renewed = begun;
      said.textContent = `one correction: ${world.took.toFixed(0)} ms; ${pace.toFixed(1)} × real time`;
    }
  }

  async function begin() {
    start.disabled = true;
    said.textContent = "loading 10 MB ...";
    loaded = await loadAll();
    const colour = (name) => getComputedStyle(page).getPropertyValue(name).trim();
    scenes = VARIABLES.map((name, k) => new Scene(loaded.THREE, figures[k].querySelector("canvas"), colour(name)));
    legend.replaceChildren(...colours().map((colour, k) => made("span", {}, colour, BELIEFS[k].kind)));
    await choose("half_cheetah");
    start.hidden = true;
    said.textContent = "";
    if (!location.search.includes("still")) await live();
  }

  start.onclick = () => begin().catch((error) => (said.textContent = error.message));

  // Tests and the film advance single steps: try.html?still
  page.advance = async (steps) => {
    for (let k = 0; k < steps; k++) await world.advance();
    shown = world.robots.map(({ frames }) => frames);
    tell();
    draw();
    return world.robots.map(({ total, speed, state, sent }) => ({ total, speed, state, sent: sent.at(-1) }));
  };
})();
