/** A live episode: what xreset/eval/play/session.py does in Python. SI units, quaternions (w, x, y, z). */

import { decoded, inverse, product, rotate } from "./physics.js";

const GRAVITY = 9.81;
const GOAL_HEIGHT = 0.6; // highest goal above the table [m]
const PULL_RATE = 10; // natural frequency of a pull at the object, critically damped [rad/s]
const PULL_LENGTH = 0.4; // distance from which a pull at the object does not become stronger [m]
const ROBOT_STIFFNESS = 500; // force of a pull at the robot for each metre [N/m]
const ROBOT_FORCE = 150; // largest force of a pull at the robot [N]
const DROPPED_SECONDS = 3; // an object that no finger touches for so long, far from its goal, counts as dropped [s]
const DROPPED_DISTANCE = 0.05; // [m]
const FALLEN = -0.2; // an object below this height has left the table [m]
const GOAL_DISTANCE = 0.02; // farther objects are not at their goal, as at the end of an evaluation [m]
const GOAL_ANGLE = Math.PI / 12; // [rad]

export class Session {
  /** physics: the world. policy: a Policy. table: the entry "table" of robot.json. */
  constructor(physics, policy, table) {
    this.physics = physics;
    this.policy = policy;
    this.scene = physics.scene;
    this.table = table;
    this.corners = decoded(this.scene.object.corners);
    this.next = 0;
    this.begin();
  }

  /** Begin again: the robot at home, the object where the next demonstration begins, its goal unless it is kept. */
  begin({ keepGoal = false } = {}) {
    const { starts, home } = this.scene;
    const start = starts[this.next % starts.length];
    this.next += 1;
    this.physics.begin(home, start.objectPos, start.objectQuat);
    this.policy.begin(this.scene.object);
    if (!keepGoal) [this.goalPos, this.goalQuat] = [start.goalPos, start.goalQuat];
    this.target = home;
    this.hand = null;
    this.count = 0;
    this.touched = 0;
    this.reading = this.physics.reading();
  }

  /** Seconds of the episode. */
  get time() {
    return this.count * this.scene.timestep;
  }

  /** Take one step of physics. The policy acts when a control step begins. */
  async step() {
    if (this.count % this.scene.substeps === 0) await this.#act();
    this.physics.step(1);
    this.count += 1;
    if (this.count % this.scene.substeps === 0) this.#read();
  }

  async #act() {
    this.target = await this.policy.act(this.reading, this.target, this.goalPos, this.goalQuat);
    const offset = this.#applyPull();
    this.physics.aim(this.target.map((target, j) => target + offset[j]));
  }

  #read() {
    this.reading = this.physics.reading();
    if (this.hand || this.reading.tipForce.some((force) => force !== 0)) this.touched = this.time;
  }

  /** Distance from the object's center, its origin in the policy's task, to the goal's [m]. */
  get distance() {
    const { objectPos, objectQuat } = this.reading;
    const at = rotate(objectQuat, this.scene.object.center);
    const goal = rotate(this.goalQuat, this.scene.object.center);
    return Math.hypot(...objectPos.map((x, i) => x + at[i] - this.goalPos[i] - goal[i]));
  }

  /** Angle from the object's orientation to the goal's [rad]. */
  get angle() {
    const [w, x, y, z] = product(this.goalQuat, inverse(this.reading.objectQuat));
    return 2 * Math.atan2(Math.hypot(x, y, z), Math.abs(w));
  }

  /** Whether the object is at its goal. */
  get isAtGoal() {
    return this.distance <= GOAL_DISTANCE && this.angle <= GOAL_ANGLE;
  }

  /** Whether the robot has lost the object, or never grasped it. */
  get dropped() {
    const fallen = this.reading.objectPos[2] < FALLEN;
    const longAgo = this.time - this.touched > DROPPED_SECONDS;
    return fallen || (longAgo && this.distance > DROPPED_DISTANCE);
  }

  // The visitor's hand ------------------------------------------------------------------------------------------------

  /** Set the goal, at the nearest position above the table that the object can have. */
  moveGoal(pos, quat) {
    const length = Math.hypot(...quat);
    this.goalQuat = quat.map((each) => each / length);
    const { center, halfSize } = this.table;
    const low = this.#restHeight(this.goalQuat);
    this.goalPos = [
      clamp(pos[0], center[0] - halfSize[0], center[0] + halfSize[0]),
      clamp(pos[1], center[1] - halfSize[1], center[1] + halfSize[1]),
      clamp(pos[2], low, Math.max(low, GOAL_HEIGHT)),
    ];
  }

  /** Return the height of the object's frame at which its lowest corner touches the table. */
  #restHeight(quat) {
    const up = rotate(inverse(quat), [0, 0, 1]);
    let lowest = Infinity;
    for (let i = 0; i < this.corners.length; i += 3) {
      const height = up[0] * this.corners[i] + up[1] * this.corners[i + 1] + up[2] * this.corners[i + 2];
      lowest = Math.min(lowest, height);
    }
    return -lowest;
  }

  /** Begin to pull at a point of the world: of a MuJoCo body of the robot, or of the object (null). */
  grab(body, point) {
    const [pos, quat] = this.#pose(body);
    this.hand = { body, local: rotate(inverse(quat), minus(point, pos)), to: point };
  }

  /** Pull the grabbed point towards a point. */
  pull(to) {
    if (this.hand) this.hand.to = to;
  }

  /** Let go. */
  release() {
    this.hand = null;
  }

  #pose(body) {
    return this.physics.bodyPose(body ?? this.scene.addresses.object.body);
  }

  /** Set the force on the object; return what a pull at the robot adds to the targets [J]. */
  #applyPull() {
    let offset = new Array(this.target.length).fill(0);
    let wrench = [[0, 0, 0], [0, 0, 0]];
    if (this.hand?.body === null) wrench = this.#pullObject();
    else if (this.hand) offset = this.#pullRobot();
    this.physics.pullObject(...wrench);
    return offset;
  }

  /** Return force and torque of a damped spring, which also carries the object's weight. */
  #pullObject() {
    const { mass, com, inertia } = this.scene.object;
    const [pos, quat] = this.#pose(null);
    const arm = rotate(quat, minus(this.hand.local, com));
    const stretch = shortened(minus(minus(this.hand.to, pos), rotate(quat, this.hand.local)), PULL_LENGTH);
    const spring = stretch.map((each) => mass * PULL_RATE ** 2 * each);
    const damping = 2 * PULL_RATE;
    const { objectLinvel, objectAngvel } = this.reading;
    const force = spring.map((each, i) => each - mass * damping * objectLinvel[i]);
    force[2] += mass * GRAVITY;
    const torque = cross(arm, spring).map((each, i) => each - inertia * damping * objectAngvel[i]);
    return [force, torque];
  }

  /** Return what to add to the targets, so that the drives give the torques of a force at the point as well. */
  #pullRobot() {
    const [pos, quat] = this.#pose(this.hand.body);
    const at = rotate(quat, this.hand.local).map((each, i) => each + pos[i]);
    const wanted = minus(this.hand.to, at).map((each) => ROBOT_STIFFNESS * each);
    const torques = this.physics.torques(this.hand.body, at, shortened(wanted, ROBOT_FORCE));
    return torques.map((torque, j) => torque / this.scene.stiffness[j]);
  }
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

function minus(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

/** Return a vector that is at most so long. */
function shortened(vector, length) {
  const factor = Math.min(1, length / Math.max(Math.hypot(...vector), 1e-6));
  return vector.map((each) => factor * each);
}
