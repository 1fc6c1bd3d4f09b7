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

class Corrector {
  static STEP = 1e-4; // of derivatives, shares of the largest command

  static async load(ort, files, actuators, model) {
    const corrector = new Corrector();
    const graphs = ["core", "measure", "belief"].map((name) => Graph.load(ort, files[`${name}_${actuators}.onnx`]));
    [corrector.core, corrector.search, corrector.weights] = await Promise.all(graphs);
    const limits = [...Array(actuators).fill(-1), ...Array(actuators).fill(1)];
    Object.assign(corrector, { actuators, model, limits });
    corrector.memory = new Float32Array(corrector.core.sizeOf("memory")).fill(0.05, -actuators);
    corrector.forget();
    return corrector;
  }

  // The last transition says nothing: there was none, or somebody moved the robot.
  forget() {
    this.measured = new Float32Array(3 * this.actuators + 2).fill(1, 2 * this.actuators, 3 * this.actuators);
  }

  async correct(planned) {
    const { memory, measured, limits } = this;
    const tick = await this.core.run({ memory, measured, planned, box: limits, limits });
    this.memory = tick.next_memory;
    return [...tick.command];
  }

  // Which command would have explained what the robot did? The model rolls until the graph knows.
  async measure(before, sent, after) {
    const { model, memory } = this;
    let search = new Float64Array(this.search.sizeOf("search"));
    let jacobian = new Float64Array(this.search.sizeOf("jacobian"));
    let expected = model.expect(before, sent);
    for (;;) {
      const error = model.difference(after, expected);
      const answer = await this.search.run({ memory, search, sent, error, jacobian });
      if (answer.wants[0] === 0) return (this.measured = answer.measured);
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

  // How probable each hypothesis is, by actuator.
  async belief() {
    const { belief } = await this.weights.run({ memory: this.memory });
    return belief;
  }
}
