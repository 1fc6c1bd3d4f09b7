// Two robots with the same policy: the first without AFM, the second with AFM between policy and motors.
"use strict";

class World {
  static async load({ mujoco, ort, files }, name) {
    const world = new World(), settings = ROBOTS[name], actuators = settings.joints.length;
    const xml = new TextDecoder().decode(files[`${name}.xml`]);
    const model = new Model(mujoco, xml, settings.skip);
    world.robots = [0, 1].map(() => new Robot(mujoco, xml, settings));
    world.policy = await Graph.load(ort, files[`${name}.onnx`]);
    world.corrector = await Corrector.load(ort, files, actuators, model);
    return Object.assign(world, { name, dt: model.dt, took: 0 });
  }

  // Healthy robots at the start, and a correction without memory.
  begin() {
    [...this.robots, this.corrector].forEach((each) => each.begin());
    this.become({});
  }

  // Change the actuators of both: gains, delay of the commands in steps, and two that are swapped.
  become(changes) {
    const gains = this.robots[0].settings.joints.map(() => 1);
    this.faults = { gains, late: 0, swapped: [0, 0], ...changes };
  }

  async planned(robot, state) {
    const { action } = await this.policy.run({ seen: robot.observe(state) });
    return Array.from(action, (value) => Math.max(-1, Math.min(1, value)));
  }

  async stepAlone(robot) {
    robot.move(await this.planned(robot, robot.state), this.faults);
  }

  async stepCorrected(robot) {
    const { corrector } = this, before = robot.state;
    if (robot.lying) {
      await this.stepAlone(robot);
      if (!robot.lying) corrector.resume();
      return;
    }
    const begun = performance.now();
    const command = await corrector.correct(await this.planned(robot, corrector.arrival(before)));
    const decided = performance.now();
    robot.move(command, this.faults);
    const moved = performance.now();
    await corrector.measure(before, command, robot.state);
    this.took = decided - begun + performance.now() - moved; // ms
  }

  async advance() {
    const [alone, corrected] = this.robots;
    await this.stepAlone(alone);
    await this.stepCorrected(corrected);
  }
}
