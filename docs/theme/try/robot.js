// Robots of gymnasium in MuJoCo, and their actuators, which fail.
"use strict";

// Simulation steps per command, coordinates of the position that a policy does not observe, the largest
// velocity that it observes, the terms of gymnasium's reward and where it measures x, and its test of a fall.
// The reward of Ant is that of gymnasium without the cost of contacts.
const ROBOTS = {
  half_cheetah: {
    title: "HalfCheetah", skip: 5, unseen: 1, fastest: Infinity, alive: 0, effort: 0.1, x: ({ qpos }) => qpos[0],
    joints: ["back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"],
    fell: () => false,
  },
  ant: {
    title: "Ant", skip: 5, unseen: 2, fastest: Infinity, alive: 1, effort: 0.5, x: ({ geom_xpos }) => geom_xpos[3],
    joints: ["right back hip", "right back ankle", "left front hip", "left front ankle",
      "right front hip", "right front ankle", "left back hip", "left back ankle"],
    fell: (position) => position[2] < 0.2 || position[2] > 1,
  },
  walker2d: {
    title: "Walker2d", skip: 4, unseen: 1, fastest: 10, alive: 1, effort: 0.001, x: ({ qpos }) => qpos[0],
    joints: ["right hip", "right knee", "right ankle", "left hip", "left knee", "left ankle"],
    fell: (position) => position[1] < 0.8 || position[1] > 2 || Math.abs(position[2]) > 1,
  },
};

class Simulation {
  static ACCURACY = [0.01, 0.1]; // standard deviation of the model's error in a step: positions, velocities

  constructor(mujoco, xml, skip) {
    this.mujoco = mujoco;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    this.skip = skip;
    this.dt = skip * this.model.opt.timestep;
  }

  get state() {
    const { qpos, qvel, qacc_warmstart } = this.data;
    return { position: [...qpos], velocity: [...qvel], warm: [...qacc_warmstart] };
  }

  set state({ position, velocity, warm }) {
    this.data.qpos.set(position);
    this.data.qvel.set(velocity);
    this.data.qacc_warmstart.set(warm);
  }

  run(controls, seen = () => {}) {
    this.data.ctrl.set(controls);
    for (let k = 0; k < this.skip; k++) {
      this.mujoco.mj_step(this.model, this.data);
      seen();
    }
  }
}

// Predicts the healthy robot. Commands beyond their range are not clipped here.
class Model extends Simulation {
  constructor(...settings) {
    super(...settings);
    this.model.opt.disableflags |= this.mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL.value;
    this.buffer = new this.mujoco.DoubleBuffer(this.model.nv);
  }

  expect(before, command) {
    this.state = before;
    this.run(command);
    return this.state;
  }

  // By how much a state is beyond another one, in standard deviations.
  difference(state, other) {
    const [position, velocity] = Simulation.ACCURACY;
    this.mujoco.mj_differentiatePos(this.model, this.buffer, 1, other.position, state.position);
    const moved = [...this.buffer.GetView()].map((value) => value / position);
    return [...moved, ...state.velocity.map((value, k) => (value - other.velocity[k]) / velocity)];
  }
}

class Robot extends Simulation {
  static LYING = 2; // s, until a robot that fell stands again
  static LONGEST = 9; // number of commands that are stored: the newest, and those that are late

  constructor(mujoco, xml, settings) {
    super(mujoco, xml, settings.skip);
    this.settings = settings;
    this.start = this.state;
    this.begin();
  }

  begin() {
    Object.assign(this, { sent: [], frames: [], track: [], total: 0, falls: 0, lying: 0 });
    this.state = this.start;
    this.mujoco.mj_forward(this.model, this.data);
    this.filmed();
  }

  // The observation of the policy.
  observe({ position, velocity }) {
    const { unseen, fastest } = this.settings;
    return [...position.slice(unseen), ...velocity.map((value) => Math.max(-fastest, Math.min(fastest, value)))];
  }

  get distance() {
    return this.data.qpos[0];
  }

  // Metres per second, over the last second.
  get speed() {
    return this.track.length < 2 ? 0 : (this.track.at(-1) - this.track[0]) / (this.dt * (this.track.length - 1));
  }

  // The reward of a step, as in gymnasium.
  reward(speed, effect) {
    const { fell, alive, effort } = this.settings;
    return speed + (fell(this.data.qpos) ? 0 : alive) - effort * effect.reduce((sum, value) => sum + value * value, 0);
  }

  // The effect of a command through the faulty actuators.
  effect(command, { gains, late, swapped }) {
    this.sent = [...this.sent, command].slice(-Robot.LONGEST);
    const arrived = this.sent.at(-1 - late) ?? command.map(() => 0);
    const [one, other] = swapped;
    const wired = arrived.with(one, arrived[other]).with(other, arrived[one]);
    return wired.map((value, k) => gains[k] * value);
  }

  move(command, faults) {
    const effect = this.effect(command, faults);
    const { x } = this.settings, from = x(this.data);
    this.frames = [];
    this.run(this.lying ? effect.map(() => 0) : effect, () => this.filmed());
    this.track = [...this.track, this.distance].slice(-1 - Math.round(1 / this.dt));
    if (this.lying) {
      if (--this.lying === 0) this.putUp();
      return;
    }
    this.total += this.reward((x(this.data) - from) / this.dt, effect);
    if (this.settings.fell(this.data.qpos)) {
      this.falls += 1;
      this.lying = Math.round(Robot.LYING / this.dt);
    }
  }

  putUp() {
    const flat = this.settings.unseen; // coordinates along the ground
    const place = [...this.data.qpos.slice(0, flat), ...this.start.position.slice(flat)];
    this.state = { ...this.start, position: place };
    this.sent = [];
  }

  filmed() {
    const { geom_xpos, geom_xmat } = this.data;
    this.frames.push({ places: [...geom_xpos], turns: [...geom_xmat] });
  }
}
