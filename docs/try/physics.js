/** One world of MuJoCo: what xreset/backends/mujoco.py does in Python, for MuJoCo's WebAssembly build.
 *
 * SI units, z up, quaternions (w, x, y, z). Arrays that a method returns are copies.
 */

const KINDS = { d: Float64Array, f: Float32Array, i: Int32Array, B: Uint8Array };

/** Return the array that ci/try_page.py wrote as text. */
export function decoded({ kind, data }) {
  const text = atob(data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new KINDS[kind](bytes.buffer);
}

export class Physics {
  /** Compile a scene.
   *
   * mujoco: the loaded module.
   * scene: content of a file scenes/OBJECT.json, which ci/try_page.py describes.
   */
  constructor(mujoco, scene) {
    this.mujoco = mujoco;
    this.scene = scene;
    this.model = mujoco.MjModel.from_xml_string(scene.xml);
    for (const [name, value] of Object.entries(scene.numbers)) {
      const there = this.model[name];
      const exact = decoded(value);
      if (there?.length !== exact.length) {
        throw new Error(`MuJoCo's ${name} has ${there?.length} numbers, expected ${exact.length}.`);
      }
      there.set(exact);
    }
    this.model.opt.timestep = scene.timestep;
    // A broken world must be reported, not reset silently. Sensors are read on demand, not in each step.
    const { mjDSBL_AUTORESET, mjDSBL_SENSOR } = mujoco.mjtDisableBit;
    this.sensing = this.model.opt.disableflags | mjDSBL_AUTORESET.value;
    this.silent = this.sensing | mjDSBL_SENSOR.value;
    this.model.opt.disableflags = this.silent;
    this.data = new mujoco.MjData(this.model);
  }

  /** Free the engine's memory. */
  close() {
    this.data.delete();
    this.model.delete();
  }

  /** Begin at rest: joint positions [J], which are the drives' targets too, and the object's pose. */
  begin(jointPos, objectPos, objectQuat) {
    this.mujoco.mj_resetData(this.model, this.data);
    const { qpos, ctrl } = this.data;
    const { qpos: place, object } = this.scene.addresses;
    place.forEach((address, j) => (qpos[address] = jointPos[j]));
    for (const mimic of this.scene.mimics) {
      qpos[mimic.qpos] = mimic.multiplier * jointPos[mimic.source] + mimic.offset;
    }
    ctrl.set(jointPos);
    qpos.set(objectPos, object.qpos);
    qpos.set(objectQuat, object.qpos + 3);
    this.#locate();
  }

  /** Give the drives joint targets [J]. */
  aim(targets) {
    this.data.ctrl.set(targets);
  }

  /** Take steps of physics. */
  step(count) {
    const { mujoco, model, data } = this;
    for (let i = 0; i < count; i++) {
      mujoco.mj_step1(model, data);
      keepSlidingContacts(data, this.scene.mostBraking);
      mujoco.mj_step2(model, data);
    }
    this.#locate();
  }

  /** Let the bodies' poses be those of the present positions: mj_step2 has moved on. */
  #locate() {
    this.mujoco.mj_kinematics(this.model, this.data);
    this.mujoco.mj_comPos(this.model, this.data);
  }

  /** Apply a force [N] and a torque [N m] at the object's centre of mass from now on. */
  pullObject(force, torque) {
    const at = 6 * this.scene.addresses.object.body;
    this.data.xfrc_applied.set([...force, ...torque], at);
  }

  /** Return the joint torques [J] of a force at a point of a body, both in the world. */
  torques(body, point, force) {
    const { mujoco, model, data } = this;
    const jacobian = new mujoco.DoubleBuffer(3 * model.nv);
    const turning = new mujoco.DoubleBuffer(3 * model.nv);
    mujoco.mj_jac(model, data, jacobian, turning, point, body);
    const rows = jacobian.GetView();
    const torque = this.scene.addresses.dof.map((dof) => {
      return [0, 1, 2].reduce((sum, axis) => sum + rows[axis * model.nv + dof] * force[axis], 0);
    });
    jacobian.delete();
    turning.delete();
    return torque;
  }

  /** Return joints, the object's pose and velocity, and the fingertips' forces [E, 3] on it. */
  reading() {
    const { mujoco, model, data, scene } = this;
    const { addresses } = scene;
    const { object } = addresses;
    model.opt.disableflags = this.sensing;
    mujoco.mj_sensorAcc(model, data); // first: these are the contacts of the last step
    mujoco.mj_step1(model, data); // poses and velocities after it
    model.opt.disableflags = this.silent;
    const tipForce = new Array(3 * scene.fingertips.length).fill(0);
    addresses.tips.forEach(({ sensor, tip }) => {
      // minus: the sensor has the force on the fingertip
      for (let axis = 0; axis < 3; axis++) tipForce[3 * tip + axis] -= data.sensordata[sensor + axis];
    });
    const objectPos = Array.from(data.qpos.subarray(object.qpos, object.qpos + 3));
    const objectQuat = Array.from(data.qpos.subarray(object.qpos + 3, object.qpos + 7));
    return {
      jointPos: addresses.qpos.map((address) => data.qpos[address]),
      jointVel: addresses.dof.map((address) => data.qvel[address]),
      objectPos,
      objectQuat,
      objectLinvel: Array.from(data.qvel.subarray(object.dof, object.dof + 3)),
      objectAngvel: rotate(objectQuat, data.qvel.subarray(object.dof + 3, object.dof + 6)),
      tipForce,
    };
  }

  /** Return the pose of a body: position and quaternion. */
  bodyPose(body) {
    const { xpos, xquat } = this.data;
    return [xpos.subarray(3 * body, 3 * body + 3), xquat.subarray(4 * body, 4 * body + 4)];
  }

  /** Return whether the simulation has broken down. */
  get broken() {
    return !(this.data.qpos.every(Number.isFinite) && this.data.qvel.every(Number.isFinite));
  }
}

/** Lower the reference accelerations of contacts by what would throw sliding bodies up, between mj_step1 and mj_step2.
 *
 * The same as keep_sliding_contacts in xreset/backends/mujoco.py; xreset/backends/mjcf_model.py has the reason.
 */
function keepSlidingContacts(data, mostBraking) {
  let row = data.ne + data.nf + data.nl; // the rows of contacts come last, four for each
  if (row >= data.nefc) return;
  const reference = data.efc_aref;
  const contacts = data.contact;
  const count = contacts.size();
  for (let i = 0; i < count; i++) {
    const contact = contacts.get(i);
    if (contact.efc_address >= 0) {
      const friction = contact.friction;
      let braking = Math.hypot(reference[row + 1], reference[row + 2]);
      if (braking > mostBraking) {
        reference[row + 1] *= mostBraking / braking;
        reference[row + 2] *= mostBraking / braking;
        braking = mostBraking;
      }
      reference[row] -= Math.hypot(friction[0] * braking, friction[2] * reference[row + 3]);
      row += 4;
    }
    contact.delete();
  }
  contacts.delete();
}

/** Return a vector turned by a unit quaternion. */
export function rotate([w, x, y, z], [a, b, c]) {
  const t = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [
    a + w * t[0] + y * t[2] - z * t[1],
    b + w * t[1] + z * t[0] - x * t[2],
    c + w * t[2] + x * t[1] - y * t[0],
  ];
}

/** Return the quaternion of the inverse rotation. */
export function inverse([w, x, y, z]) {
  return [w, -x, -y, -z];
}

/** Return the quaternion of rotation b, then a. */
export function product([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}
