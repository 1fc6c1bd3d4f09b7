// The correction: the core, and what asks a model for its input. The same loop in C: examples/deploy/c.
"use strict";

class Graph {
  static async load(ort, bytes) {
    const graph = new Graph();
    graph.session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"] });
    graph.Tensor = ort.Tensor;
    return graph;
  }

  sizeOf(input) {
    const { shape } = this.session.inputMetadata.find(({ name }) => name === input);
    return shape.reduce((product, size) => product * size);
  }

  async run(values) {
    const kinds = { float32: Float32Array, float64: Float64Array }, inputs = {};
    for (const { name, type, shape } of this.session.inputMetadata) {
      inputs[name] = new this.Tensor(type, kinds[type].from(values[name]), shape);
    }
    const outputs = Object.entries(await this.session.run(inputs));
    return Object.fromEntries(outputs.map(([name, tensor]) => [name, tensor.data]));
  }
}

// What the core's hypotheses are shown as, by their names: the first that fits.
const BELIEFS = [
  { kind: "nothing has changed", colour: "#9aa5b1", names: /^nothing/ },
  { kind: "another gain", colour: "#2a9d6f", names: /^(reversed|line|gain(_now)?)\b/, words: (gain) => `gain ${gain}` },
  { kind: "what the network says", colour: "#3d7dca", names: /^(recent|varied)/, words: (gain) => `gain ${gain}` },
  { kind: "joints are mixed", colour: "#d1495b", names: /^(swapped|affine)/ },
  { kind: "late", colour: "#7b5ea7", names: /delay_|lag_/, words: (_, delay) => `${delay || "some"} steps late` },
  { kind: "something else", colour: "#e3b23c", names: /./ },
];

class Corrector {
  static STEP = 1e-4; // of derivatives, shares of the largest command

  static async load(ort, files, actuators, model) {
    const corrector = Object.assign(new Corrector(), { actuators, model });
    const graphs = ["core", "measure", "look"].map((name) => Graph.load(ort, files[`${name}_${actuators}.onnx`]));
    [corrector.core, corrector.rounds, corrector.look] = await Promise.all(graphs);
    corrector.limits = [...Array(actuators).fill(-1), ...Array(actuators).fill(1)];
    corrector.hypotheses = JSON.parse(new TextDecoder().decode(files["hypotheses.json"]));
    corrector.fresh = new Float32Array(corrector.core.sizeOf("memory")).fill(0.05, -actuators);
    corrector.nothing = await corrector.look.run({ memory: corrector.fresh });
    corrector.begin();
    return corrector;
  }

  // Know nothing.
  begin() {
    const gains = Array.from({ length: this.actuators }, () => [0, 0]); // sums of effects by commands, and squares
    Object.assign(this, { memory: this.fresh, seen: this.nothing, gains, carryover: 0 });
    this.forget();
  }

  // The last transition says nothing: there was none, or somebody moved the robot.
  forget() {
    this.measured = new Float32Array(3 * this.actuators + 2).fill(1, 2 * this.actuators, 3 * this.actuators);
  }

  // The robot was put up again: what is known of its actuators stays, what was under way is gone.
  resume() {
    this.memory = this.seen.resumed;
    this.carryover = this.seen.delay[0];
    this.forget();
  }

  // The state in which the next command will act, after those that are under way.
  arrival(state) {
    const { delay, under_way: effects } = this.seen, size = this.actuators;
    for (let age = delay[0]; age > 0; age--) {
      const start = effects.length - age * size;
      state = this.model.expect(state, effects.slice(start, start + size));
    }
    return state;
  }

  async correct(planned) {
    const { memory, measured, limits } = this;
    const tick = await this.core.run({ memory, measured, planned, box: limits, limits });
    this.memory = tick.next_memory;
    this.seen = await this.look.run(this);
    this.gains = this.gains.map(([product, square], k) => {
      const command = tick.command[k];
      return [0.9 * product + tick.predicted[k] * command, 0.9 * square + command ** 2];
    });
    return [...tick.command];
  }

  // Which command would have explained what the robot did? The model rolls until the graph knows.
  async measure(before, sent, after) {
    const { model, memory, rounds } = this;
    if (this.carryover-- > 0) return this.forget();
    let search = new Float64Array(rounds.sizeOf("search"));
    let jacobian = new Float64Array(rounds.sizeOf("jacobian"));
    let expected = model.expect(before, sent);
    for (;;) {
      const error = model.difference(after, expected);
      const answer = await rounds.run({ memory, search, sent, error, jacobian });
      this.measured = answer.measured;
      if (answer.wants[0] === 0) return;
      search = answer.next_search;
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
    const { weights, delay } = this.seen;
    const kinds = this.hypotheses.map(([name, followsDelay]) => {
      const told = followsDelay && delay[0] ? `${name} delay_` : name;
      return BELIEFS.findIndex(({ names }) => names.test(told));
    });
    return this.gains.map(([product, square], joint) => {
      const shares = BELIEFS.map(() => 0), gain = Math.round((10 * product) / square) / 10;
      kinds.forEach((kind, k) => (shares[kind] += weights[k * this.actuators + joint]));
      const { kind, words = () => kind } = BELIEFS[shares.indexOf(Math.max(...shares))];
      return { shares, words: words(gain, delay[0]) };
    });
  }
}
