/** The page: loads everything, runs the episode in real time, and answers the controls. */

import { Physics } from "./physics.js";
import { Policy } from "./policy.js";
import { Session } from "./session.js";
import { View } from "./view.js";

const FIRST = "005_tomato_soup_can";
const LONGEST = 0.2; // a picture later than this slows the episode down instead of taking more steps [s]
const SLOW = 1 / 25; // pictures that take longer make the next ones simpler [s]
const NOTICE_SECONDS = 4;
const WRITE_SECONDS = 0.2; // between two updates of the text

const element = (id) => document.getElementById(id);
const status = element("status");

/** What tests and curious visitors look at. */
const page = { view: null, session: null, factor: 0, times: {} };
window.xreset = page;

let paused = false;
let mujoco = null;
let policy = null;
let robot = null;
let loading = 0; // number of the newest choice of an object
const queue = []; // what a visitor has asked for, until the next picture: the policy may be acting

async function fetched(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status} ${answer.statusText}`);
  return answer;
}

const scene = async (name) => (await fetched(`scenes/${name}.json`)).json();

/** Load; the first picture comes before physics and policy. */
async function begin() {
  const parts = [loadMujoco(), loadPolicy()];
  parts.forEach((part) => part.catch(() => {})); // awaited below
  const first = scene(FIRST);
  robot = await (await fetched("robot.json")).json();
  const view = new View(element("picture"), robot);
  page.view = view;
  showChoices();
  const content = await first;
  const start = content.starts[0];
  view.showObject(content.object.mesh);
  view.hands = hands;
  const body = (number) => robot.home[number];
  const object = [start.objectPos, start.objectQuat];
  view.draw(body, object, [start.goalPos, start.goalQuat]);
  mark("picture");
  [mujoco, policy] = await Promise.all(parts);
  open(content);
  mark("ready");
  element("hint").hidden = false;
  requestAnimationFrame(frame);
}

async function loadMujoco() {
  const { default: load } = await import("mujoco");
  return load();
}

async function loadPolicy() {
  const content = fetched("policy.onnx");
  const ort = await import("onnxruntime");
  ort.env.wasm.wasmPaths = new URL("lib/", document.baseURI).href;
  ort.env.wasm.numThreads = 1; // more need headers that a static site lacks
  ort.env.wasm.proxy = true; // in a worker: the picture goes on meanwhile
  const bytes = new Uint8Array(await (await content).arrayBuffer());
  return Policy.load(ort, bytes);
}

function mark(name) {
  page.times[name] = performance.now() / 1000;
}

/** Play with the object of a scene. */
function open(content) {
  page.session?.physics.close();
  page.session = new Session(new Physics(mujoco, content), policy, robot.table);
}

// Running --------------------------------------------------------------------------------------------------------------

let before = 0; // time of the last picture [s]
let owed = 0; // steps of physics that are due
let written = 0;
let played = 0; // seconds played since the text was written
let slowness = 0; // mean time between two pictures, over about a second [s]

async function frame(now) {
  const elapsed = Math.min(now / 1000 - before, LONGEST);
  before = now / 1000;
  slowness += (elapsed - slowness) / 30;
  if (slowness > SLOW) {
    page.view.simplify();
    slowness = 0;
  }
  try {
    while (queue.length) queue.shift()();
    if (!paused) await play(elapsed);
    draw();
    write();
  } catch (error) {
    tell(error);
    return;
  }
  requestAnimationFrame(frame);
}

async function play(elapsed) {
  const { session } = page;
  const { timestep } = session.scene;
  owed = Math.min(owed + elapsed / timestep, LONGEST / timestep);
  while (owed >= 1) {
    await session.step();
    owed -= 1;
    played += timestep;
  }
  if (session.physics.broken) {
    notify("The simulation broke down. A new episode begins.");
    session.begin();
  } else if (session.dropped) {
    notify("Dropped. The robot tries again from home.");
    page.view.release();
    session.begin({ keepGoal: true });
  }
}

function draw() {
  const { view, session } = page;
  const { object } = session.scene.addresses;
  const body = (number) => session.physics.bodyPose(number);
  view.draw(body, body(object.body), [session.goalPos, session.goalQuat]);
  const [x, y] = view.ballOnPage;
  Object.assign(element("hint").style, { left: `${x}px`, top: `${y}px` });
}

function write() {
  const seconds = before - written;
  if (seconds < WRITE_SECONDS) return;
  page.factor = played / seconds;
  written = before;
  played = 0;
  const { distance, angle, isAtGoal } = page.session;
  const way = `${(100 * distance).toFixed(1)} cm and ${((180 * angle) / Math.PI).toFixed(0)}°`;
  status.textContent = isAtGoal ? `At the goal: ${way} off.` : `${way} from the goal.`;
  if (paused) status.textContent = "Paused.";
  status.classList.toggle("good", isAtGoal && !paused);
}

// Controls -------------------------------------------------------------------------------------------------------------

const hands = {
  moveGoal(pos, quat) {
    element("hint").hidden = true;
    page.session?.moveGoal(pos, quat);
    if (paused && page.session) draw();
  },
  grab: (body, point) => page.session?.grab(body, point),
  pull: (to) => page.session?.pull(to),
  release: () => page.session?.release(),
};

function showChoices() {
  for (const [name, label] of Object.entries(robot.objects)) {
    const button = document.createElement("button");
    button.textContent = label;
    button.dataset.name = name;
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", String(name === FIRST));
    button.addEventListener("click", () => choose(name).catch(tell));
    element("objects").append(button);
  }
}

async function choose(name) {
  loading += 1;
  const choice = loading;
  for (const button of element("objects").children) {
    button.setAttribute("aria-checked", String(button.dataset.name === name));
  }
  const content = await scene(name);
  if (choice !== loading) return; // another one was chosen since
  queue.push(() => {
    page.view.release();
    page.view.showObject(content.object.mesh);
    open(content);
  });
}

element("pause").addEventListener("click", () => {
  paused = !paused;
  element("pause").textContent = paused ? "Go on" : "Pause";
  written = 0;
});

element("restart").addEventListener("click", () => {
  queue.push(() => {
    page.view.release();
    page.session.begin();
  });
});

document.addEventListener("visibilitychange", () => {
  before = performance.now() / 1000;
});

let noticed = 0;

function notify(text) {
  element("notice").textContent = text;
  element("notice").hidden = false;
  clearTimeout(noticed);
  noticed = setTimeout(() => (element("notice").hidden = true), 1000 * NOTICE_SECONDS);
}

function tell(error) {
  console.error(error);
  status.classList.remove("good");
  status.textContent = `This page does not work here: ${String(error.message ?? error).slice(0, 160)}`;
}

begin().catch(tell);
