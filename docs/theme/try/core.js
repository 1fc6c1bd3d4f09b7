// The correction: the core, and what asks a model for its input. The same loop in Python: examples/deploy/core_alone.py.
"use strict";

class Graph {
  static KINDS = { float32: Float32Array, float64: Float64Array };

  static async load(ort, bytes) {
    const graph = new Graph();
    graph.session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"] });
    graph.Tensor = ort.Tensor;
    return graph;
  }

  // Zeros for the fields of a record among the inputs, such as "memory.".
  zeros(record) {
    const inputs = this.session.inputMetadata.filter(({ name }) => name.startsWith(record));
    return Object.fromEntries(inputs.map(({ name, type, shape }) => {
      return [name, new Graph.KINDS[type](shape.reduce((product, size) => product * size, 1))];
    }));
  }

  async run(values) {
    const inputs = {};
    for (const { name, type, shape } of this.session.inputMetadata) {
      inputs[name] = new this.Tensor(type, Graph.KINDS[type].from(values[name]), shape);
    }
    const outputs = Object.entries(await this.session.run(inputs));
    return Object.fromEntries(outputs.map(([name, tensor]) => [name, tensor.data]));
  }
}

// The fields of a record that a graph returned, as inputs of the next call: next_memory.noise is memory.noise.
function record(answer, name) {
  const fields = Object.entries(answer).filter(([field]) => field.startsWith(name));
  return Object.fromEntries(fields.map(([field, value]) => [field.replace("next_", ""), value]));
}

// What the core's hypotheses are shown as, by their names: the first that fits.
const BELIEFS = [
  { kind: "no fault", colour: "#9aa5b1", names: /^no fault$/ },
  { kind: "late", colour: "#7b5ea7", names: /late|lag|delay/, words: (_, delay) => `${delay || "some"} steps late` },
  { kind: "another gain", colour: "#2a9d6f", names: /reversed|gain|line|fading|curve|by sign/, words: (gain) => `gain ${gain}` },
  { kind: "joints are mixed", colour: "#d1495b", names: /swapped|affine/ },
  { kind: "something else", colour: "#e3b23c", names: /./ },
];

class Corrector {
  static STEP = 1e-4; // of derivatives, shares of the largest command

  static async load(ort, files, actuators, model) {
    const corrector = Object.assign(new Corrector(), { actuators, model });
    const graphs = ["core", "measure", "belief"].map((name) => Graph.load(ort, files[`${name}_${actuators}.onnx`]));
    [corrector.core, corrector.rounds, corrector.weigh] = await Promise.all(graphs);
    const [low, high] = [-1, 1].map((end) => Array(actuators).fill(end));
    corrector.bounds = { "plan.low": low, "plan.high": high, "plan.limit_low": low, "plan.limit_high": high };
    corrector.hypotheses = JSON.parse(new TextDecoder().decode(files["hypotheses.json"]));
    corrector.fresh = corrector.core.zeros("memory.");
    corrector.fresh["memory.noise"].fill(0.05);
    corrector.begin();
    await corrector.look();
    corrector.unknown = corrector.weights;
    return corrector;
  }

  // Know nothing.
  begin() {
    const gains = Array.from({ length: this.actuators }, () => [0, 0]); // sums of effects by commands, and squares
    Object.assign(this, { memory: this.fresh, weights: this.unknown, gains, carryover: 0 });
    this.forget(Array(this.actuators).fill(0));
  }

  // A transition does not count: there was none, or somebody moved the robot.
  forget(sent) {
    this.measurement = this.core.zeros("measurement.");
    this.measurement["measurement.commands"] = this.measurement["measurement.effects"] = sent;
  }

  // The robot was put up again: what is known of its actuators stays, what was under way is gone.
  resume() {
    const { "memory.pending": pending, "memory.plans": plans } = this.fresh;
    this.memory = { ...this.memory, "memory.pending": pending, "memory.plans": plans };
    this.carryover = this.delay;
    this.forget(Array(this.actuators).fill(0));
  }

  get delay() {
    return this.memory["memory.delay"][0];
  }

  // The state in which the next command will act, after those that are under way.
  arrival(state) {
    const effects = this.memory["memory.pending"], kept = effects.length / this.actuators;
    for (let age = this.delay; age > 0; age--) {
      state = this.model.expect(state, [...effects].filter((_, k) => k % kept === kept - age));
    }
    return state;
  }

  async look() {
    this.weights = (await this.weigh.run(this.memory)).weights;
  }

  async correct(planned) {
    const { memory, measurement, bounds } = this;
    const tick = await this.core.run({ ...memory, ...measurement, ...bounds, "plan.action": planned });
    this.memory = record(tick, "next_memory.");
    await this.look();
    const { "step.command": commands, "step.effect": effects } = tick;
    this.gains = this.gains.map(([product, square], k) => {
      return [0.9 * product + effects[k] * commands[k], 0.9 * square + commands[k] ** 2];
    });
    return [...commands];
  }

  // Which command would have explained what the robot did? The model rolls until the graph knows.
  async measure(before, sent, after) {
    const { model, memory, rounds } = this;
    if (this.carryover-- > 0) return this.forget(sent);
    let search = rounds.zeros("search."), { jacobian } = rounds.zeros("jacobian");
    let expected = model.expect(before, sent);
    for (;;) {
      const error = model.difference(after, expected);
      const answer = await rounds.run({ ...memory, ...search, sent, error, jacobian });
      this.measurement = record(answer, "measurement.");
      if (answer.wants[0] === 0) return;
      search = record(answer, "next_search.");
      const asked = [...answer.asked];
      expected = model.expect(before, asked);
      if (answer.wants[0] === 2) jacobian = this.derivative(before, asked, expected);
    }
  }

  derivative(before, asked, expected) {
    const columns = asked.map((_, k) => {
      const beside = asked.with(k, asked[k] + Corrector.STEP);
      return this.model.difference(this.model.expect(before, beside), expected);
    });
    return columns[0].flatMap((_, row) => columns.map((column) => column[row] / Corrector.STEP));
  }

  // How probable each kind of hypothesis is, of each actuator, and what the likeliest one says.
  get belief() {
    const { weights, hypotheses, delay } = this;
    const kinds = hypotheses.map((name) => BELIEFS.findIndex(({ names }) => names.test(name)));
    return this.gains.map(([product, square], joint) => {
      const shares = BELIEFS.map(() => 0), gain = Math.round((10 * product) / square) / 10;
      kinds.forEach((kind, k) => (shares[kind] += weights[joint * kinds.length + k]));
      const { kind, words = () => kind } = BELIEFS[shares.indexOf(Math.max(...shares))];
      return { shares, words: words(gain, delay) };
    });
  }
}
