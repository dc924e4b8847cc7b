// Worlds and policies of docs/try for tests/wasm_engine.py: one JSON command a line in, one answer a line out.

import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [packages, sources] = process.argv.slice(2).map((path) => pathToFileURL(path).href);
const { default: load } = await import(`${packages}/@mujoco/mujoco/mujoco.js`);
const ort = await import(`${packages}/onnxruntime-web/dist/ort.node.min.mjs`);
const { Physics } = await import(`${sources}/physics.js`);
const { Policy } = await import(`${sources}/policy.js`);
const { Session } = await import(`${sources}/session.js`);
ort.env.wasm.numThreads = 1;
const mujoco = await load();
const worlds = [];
let policy = null;

const commands = {
  build({ scene, instead }) {
    worlds[instead]?.close();
    return worlds.push(new Physics(mujoco, scene)) - 1;
  },
  arrays({ world, names }) {
    const { model } = worlds[world];
    return names.map((name) => (model[name] ? Array.from(model[name]) : null));
  },
  begin({ world, jointPos, jointTarget, objectPos, objectQuat }) {
    worlds[world].begin(jointPos, objectPos, objectQuat);
    worlds[world].aim(jointTarget);
    return worlds[world].reading();
  },
  step({ world, count, targets, force, torque }) {
    worlds[world].aim(targets);
    worlds[world].pullObject(force, torque);
    worlds[world].step(count);
    return worlds[world].reading();
  },
  async load({ folder, object }) {
    policy = await Policy.load(ort, readFileSync(`${folder}/policy.onnx`));
    policy.begin(object);
  },
  act({ reading, target, goalPos, goalQuat }) {
    return policy.act(reading, target, goalPos, goalQuat);
  },
  errors(state) {
    const { distance, angle, isAtGoal } = Object.assign(Object.create(Session.prototype), state);
    return [distance, angle, isAtGoal];
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  const answer = await commands[command.do](command);
  process.stdout.write(`${JSON.stringify(answer ?? null)}\n`);
}
