/** A deployed policy: one graph from readings to joint targets (docs/live.md). xreset/runtime/controller.py is the same
 * in Python.
 */

export class Policy {
  /** ort: the loaded onnxruntime-web. content: bytes of policy.onnx. */
  static async load(ort, content) {
    const options = { executionProviders: ["wasm"], graphOptimizationLevel: "all" };
    return new Policy(ort, await ort.InferenceSession.create(content, options));
  }

  constructor(ort, session) {
    this.ort = ort;
    this.session = session;
  }

  /** Begin an episode with an object: the entry "object" of a scene. */
  begin(object) {
    this.object = object;
    const { shape } = this.session.inputMetadata.find(({ name }) => name === "memory_in");
    this.memory = new Float32Array(shape[1]);
  }

  /** Return joint targets [J].
   *
   * reading: of Physics. target: the present targets [J]. goalPos, goalQuat: pose of the goal.
   */
  async act(reading, target, goalPos, goalQuat) {
    const values = {
      joint_pos: reading.jointPos,
      joint_vel: reading.jointVel,
      joint_target: target,
      object_pos: reading.objectPos,
      object_quat: reading.objectQuat,
      tip_force: reading.tipForce,
      goal_pos: goalPos,
      goal_quat: goalQuat,
      object_points: this.object.points,
      object_normals: this.object.normals,
      object_center: this.object.center,
      memory_in: this.memory,
    };
    const feeds = {};
    for (const { name, shape } of this.session.inputMetadata) {
      const numbers = Float32Array.from(values[name]);
      feeds[name] = new this.ort.Tensor("float32", numbers, [1, ...shape.slice(1)]);
    }
    const outputs = await this.session.run(feeds, ["target", "memory_out"]);
    this.memory = outputs.memory_out.data.slice();
    return Array.from(outputs.target.data);
  }
}
