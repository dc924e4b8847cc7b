/** An exported policy: observations, network and joint targets, as in xreset/task/observations.py and actions.py. */

import { inverse, product, rotate } from "./physics.js";

/** Name of an observation -> function of what is known in a step and the observation's parameters. */
const TERMS = {
  object_pos: (x) => x.objectPos,
  goal_pos: (x) => x.goalPos,
  rotation_to_goal: (x) => columns(product(x.goalQuat, inverse(x.objectQuat))),
  gravity_fraction: () => [1],
  previous_action: (x) => x.action,
  joint_pos: (x) => x.jointPos.map((q, j) => (2 * (q - x.lower[j])) / (x.upper[j] - x.lower[j]) - 1),
  joint_vel: (x, { scale }) => x.jointVel.map((v) => scale * v),
  palm_pos: (x) => x.links.pos.slice(0, 3),
  palm_rotation: (x) => columns(x.links.quat.slice(0, 4)),
  palm_linvel: (x) => x.links.linvel.slice(0, 3),
  palm_angvel: (x) => x.links.angvel.slice(0, 3),
  tip_pos: (x) => x.links.pos.slice(3),
  tip_force: (x, { scale }) => x.tipForce.map((force) => clamp(scale * force, -1, 1)),
  joint_target: (x) => x.target.map((target, j) => target - x.jointPos[j]),
};

export class Policy {
  /** ort: the loaded onnxruntime-web. content: bytes of policy.onnx. contract: content of policy.json. */
  static async load(ort, content, contract) {
    const options = { executionProviders: ["wasm"], graphOptimizationLevel: "all" };
    return new Policy(ort, await ort.InferenceSession.create(content, options), contract);
  }

  constructor(ort, session, contract) {
    this.ort = ort;
    this.session = session;
    this.contract = contract;
  }

  /** Begin an episode with an object: the entry "object" of a scene. */
  begin(object) {
    const { joints, units } = this.contract;
    this.center = object.center;
    this.points = [];
    for (let i = 0; i < object.points.length; i += 3) {
      this.points.push([0, 1, 2].map((axis) => object.points[i + axis] - object.center[axis]));
    }
    this.action = new Array(joints).fill(0);
    this.state = [new Float32Array(units), new Float32Array(units)];
  }

  /** Return joint targets [J].
   *
   * reading: of Physics. target: the present targets [J]. goalPos, goalQuat: pose of the goal's frame.
   */
  async act(reading, target, goalPos, goalQuat) {
    const known = {
      ...reading,
      objectPos: added(reading.objectPos, rotate(reading.objectQuat, this.center)),
      goalPos: added(goalPos, rotate(goalQuat, this.center)),
      goalQuat,
      target,
      action: this.action,
      lower: this.contract.scaledLower,
      upper: this.contract.scaledUpper,
    };
    const flat = this.contract.terms.flatMap(([name, parameters]) => TERMS[name](known, parameters));
    const { units, scale } = this.contract;
    const { Tensor } = this.ort;
    const outputs = await this.session.run({
      flat: new Tensor("float32", Float32Array.from(flat), [1, flat.length]),
      cloud: new Tensor("float32", this.#cloud(known, scale), [1, 1, this.points.length, 9]),
      h_in: new Tensor("float32", this.state[0], [1, 1, units]),
      c_in: new Tensor("float32", this.state[1], [1, 1, units]),
    });
    this.state = [outputs.h_out.data.slice(), outputs.c_out.data.slice()];
    this.action = Array.from(outputs.actions.data, (action) => clamp(action, -1, 1));
    return this.#targets(reading.jointPos, target);
  }

  /** Return each point of the object, its place at the goal, and the way there. */
  #cloud({ objectPos, objectQuat, goalPos, goalQuat }, scale) {
    const cloud = new Float32Array(9 * this.points.length);
    this.points.forEach((point, i) => {
      const here = added(objectPos, rotate(objectQuat, point));
      const there = added(goalPos, rotate(goalQuat, point));
      const way = there.map((each, axis) => each - here[axis]);
      cloud.set([...here, ...there, ...way].map((each) => scale * each), 9 * i);
    });
    return cloud;
  }

  #targets(jointPos, target) {
    const { step, lead, lower, upper, absolute, zero, below, above } = this.contract;
    return this.action.map((action, j) => {
      let next = clamp(target[j] + step[j] * action, jointPos[j] - lead[j], jointPos[j] + lead[j]);
      if (absolute[j]) next = zero[j] + (action < 0 ? below[j] : above[j]) * action;
      return clamp(next, lower[j] ?? -Infinity, upper[j] ?? Infinity);
    });
  }
}

/** Return the first two columns of a rotation's matrix. */
function columns(quat) {
  return [...rotate(quat, [1, 0, 0]), ...rotate(quat, [0, 1, 0])];
}

function added(a, b) {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
