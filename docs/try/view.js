/** The picture: robot, table, object and goal, and what a visitor drags in it. z is up, in metres. */

import * as THREE from "three";
import { OrbitControls } from "./lib/OrbitControls.js";
import { TransformControls } from "./lib/TransformControls.js";
import { decoded } from "./physics.js";

const LOOK_AT = new THREE.Vector3(0.5, 0.22, 0.29);
const EYE = new THREE.Vector3(1.22, -0.47, 0.77);
const RIGHT = new THREE.Vector3(0.79, 0.61, 0);
const GROWTH = 1.03; // the pointer meets the goal first where object and goal are in one place
const FIELD = 42; // vertical field of view [degrees]
const CELL = 0.1; // side of a square of the table [m]
const QUALITIES = [{ ratio: 2, shadows: true }, { ratio: 1, shadows: true }, { ratio: 0.6, shadows: false }];

/** What a visitor does; main.js replaces these functions. Points are arrays [3], quaternions (w, x, y, z). */
const NO_HANDS = { moveGoal() {}, grab() {}, pull() {}, release() {} };

export class View {
  /** canvas: where to draw. robot: content of robot.json. */
  constructor(canvas, robot) {
    this.hands = NO_HANDS;
    this.canvas = canvas;
    this.colors = robot.colors;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.quality = 0;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.05, 20);
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.maxPolarAngle = 1.5;
    this.orbit.minDistance = 0.3;
    this.orbit.maxDistance = 4;
    this.#light();
    this.scene.add(table(robot.table, robot.colors.table));
    this.parts = robot.parts.map((part) => {
      const mesh = solid(part.mesh, part.color);
      mesh.userData = { body: part.body };
      this.scene.add(mesh);
      return mesh;
    });
    this.#handle();
    this.resize();
    this.#lookAround();
    window.addEventListener("resize", () => this.resize());
    canvas.addEventListener("pointerdown", (event) => this.#press(event));
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => this.release());
  }

  #light() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb8b0a4, 2));
    this.renderer.shadowMap.enabled = true;
    const sun = new THREE.DirectionalLight(0xffffff, 2);
    this.sun = sun;
    sun.position.set(1.2, -0.6, 2.2);
    sun.target.position.copy(LOOK_AT);
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.radius = 4;
    Object.assign(sun.shadow.camera, { left: -1.2, right: 1.2, top: 1.2, bottom: -1.2, far: 5 });
    this.scene.add(sun, sun.target);
  }

  /** Make what the goal is dragged and turned with. */
  #handle() {
    const green = color(this.colors.goal);
    const material = new THREE.MeshStandardMaterial({ color: green, roughness: 0.5 });
    this.ball = new THREE.Mesh(new THREE.SphereGeometry(0.018, 24, 16), material);
    this.turned = new THREE.Object3D(); // what the rings turn
    this.rings = new TransformControls(this.camera, this.canvas);
    this.rings.setMode("rotate");
    this.rings.setSize(0.55);
    this.rings.showE = false; // three rings are enough; between them, the goal is dragged
    this.rings.showXYZE = false;
    this.rings.attach(this.turned);
    this.rings.addEventListener("objectChange", () => this.#turn());
    this.rings.addEventListener("dragging-changed", ({ value }) => {
      this.orbit.enabled = !value;
    });
    this.string = new THREE.Line(
      new THREE.BufferGeometry(),
      new THREE.LineBasicMaterial({ color: 0x1f2733 }),
    );
    this.string.frustumCulled = false;
    this.string.visible = false;
    this.scene.add(this.ball, this.turned, this.rings.getHelper(), this.string);
  }

  /** Aim the camera; on a phone the text above and the controls below leave the middle to the robot. */
  #lookAround() {
    const portrait = this.camera.aspect < 1;
    const target = LOOK_AT.clone();
    if (portrait) target.z -= 0.05;
    const away = EYE.clone().sub(LOOK_AT).multiplyScalar(portrait ? 1.45 : 1.05);
    this.orbit.target.copy(target);
    this.camera.position.copy(target).add(away);
    this.orbit.update();
  }

  /** Draw faster, where a machine draws slowly. */
  simplify() {
    this.quality = Math.min(this.quality + 1, QUALITIES.length - 1);
    this.resize();
  }

  resize() {
    const { ratio, shadows } = QUALITIES[this.quality];
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, ratio));
    this.sun.castShadow = shadows;
    const { clientWidth, clientHeight } = this.canvas;
    this.camera.aspect = clientWidth / Math.max(1, clientHeight);
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(clientWidth, clientHeight, false);
  }

  /** Show another object. mesh: the entry "mesh" of a scene's object. */
  showObject(mesh) {
    this.scene.remove(this.object, this.goal);
    this.object = solid(mesh, this.colors.object);
    this.object.userData = { body: null };
    this.goal = solid(mesh, this.colors.goal);
    this.goal.castShadow = false;
    Object.assign(this.goal.material, { transparent: true, opacity: 0.45, depthWrite: false });
    const { boundingBox } = this.goal.geometry;
    const middle = boundingBox.getCenter(new THREE.Vector3());
    this.goal.geometry.translate(-middle.x, -middle.y, -middle.z);
    this.goal.geometry.scale(GROWTH, GROWTH, GROWTH);
    this.goal.geometry.translate(middle.x, middle.y, middle.z);
    this.radius = Math.max(...boundingBox.getSize(new THREE.Vector3())) / 2;
    this.scene.add(this.object, this.goal);
  }

  /** Draw.
   *
   * bodyPose: function of a MuJoCo body's number: position and quaternion.
   * object, goal: position and quaternion; object is null while it is away.
   */
  draw(bodyPose, object, goal) {
    for (const mesh of this.parts) pose(mesh, ...bodyPose(mesh.userData.body));
    this.object.visible = object !== null;
    if (object) pose(this.object, ...object);
    pose(this.goal, ...goal);
    this.ball.position.copy(this.goal.position).addScaledVector(RIGHT, 1.5 * this.radius + 0.03);
    this.turned.position.copy(this.goal.position);
    if (!this.rings.dragging) this.turned.quaternion.copy(this.goal.quaternion);
    this.#drawString();
    this.renderer.render(this.scene, this.camera);
  }

  /** Return where the ball next to the goal is on the page [pixels]. */
  get ballOnPage() {
    return this.onPage(this.ball.position);
  }

  /** Return where a point of the world is on the page [pixels]. */
  onPage(point) {
    const { x, y } = new THREE.Vector3().copy(point).project(this.camera);
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  // Dragging ----------------------------------------------------------------------------------------------------------

  #ray(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * 2 - 1;
    const y = 1 - ((event.clientY - box.top) / box.height) * 2;
    const caster = new THREE.Raycaster();
    caster.setFromCamera(new THREE.Vector2(x, y), this.camera);
    return caster;
  }

  #press(event) {
    if (this.rings.dragging || !this.goal || this.held) return;
    const things = [this.ball, this.goal, this.object, ...this.parts].filter((each) => each.visible);
    const [hit] = this.#ray(event).intersectObjects(things, false);
    if (!hit) return;
    this.orbit.enabled = false;
    this.canvas.setPointerCapture(event.pointerId);
    const facing = this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(facing, hit.point);
    this.held = { thing: hit.object, plane, at: hit.point.clone(), to: hit.point.clone() };
    if (this.#holdsGoal) {
      this.held.offset = this.goal.position.clone().sub(hit.point);
    } else {
      const body = hit.object.userData.body;
      this.held.local = hit.object.worldToLocal(hit.point.clone());
      this.hands.grab(body, hit.point.toArray());
    }
  }

  get #holdsGoal() {
    return this.held.thing === this.goal || this.held.thing === this.ball;
  }

  #drag(event) {
    if (!this.held) return;
    const point = this.#ray(event).ray.intersectPlane(this.held.plane, this.held.to);
    if (!point) return;
    if (this.#holdsGoal) {
      this.hands.moveGoal(point.clone().add(this.held.offset).toArray(), quat(this.goal));
    } else {
      this.hands.pull(point.toArray());
    }
  }

  /** Let go of what is dragged. */
  release() {
    this.orbit.enabled = true;
    if (this.held && !this.#holdsGoal) this.hands.release();
    this.held = null;
  }

  #turn() {
    this.hands.moveGoal(this.goal.position.toArray(), quat(this.turned));
  }

  /** Show a string from the grabbed point to the pointer. */
  #drawString() {
    this.string.visible = Boolean(this.held?.local);
    if (!this.string.visible) return;
    this.held.thing.updateMatrixWorld();
    const from = this.held.thing.localToWorld(this.held.local.clone());
    this.string.geometry.setFromPoints([from, this.held.to]);
  }
}

// Meshes ---------------------------------------------------------------------------------------------------------------

function color([red, green, blue]) {
  return new THREE.Color().setRGB(red / 255, green / 255, blue / 255, THREE.SRGBColorSpace);
}

function solid({ vertices, normals, faces }, rgb) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(decoded(vertices), 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(decoded(normals), 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(decoded(faces)), 1));
  geometry.computeBoundingBox();
  const material = new THREE.MeshStandardMaterial({ color: color(rgb), roughness: 0.55 });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.castShadow = true;
  mesh.receiveShadow = true;
  return mesh;
}

/** Return the table as a chequerboard. */
function table({ center, halfSize }, colors) {
  const size = halfSize.map((half) => 2 * half);
  const squares = new Uint8Array(colors.concat([...colors].reverse()).flatMap((rgb) => [...rgb, 255]));
  const texture = new THREE.DataTexture(squares, 2, 2);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.magFilter = THREE.NearestFilter;
  texture.wrapS = THREE.RepeatWrapping;
  texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(size[0] / (2 * CELL), size[1] / (2 * CELL));
  texture.needsUpdate = true;
  const material = new THREE.MeshStandardMaterial({ map: texture, roughness: 0.9 });
  const top = new THREE.Mesh(new THREE.BoxGeometry(...size), material);
  top.position.set(center[0], center[1], -halfSize[2]);
  top.receiveShadow = true;
  return top;
}

function pose(mesh, position, [w, x, y, z]) {
  mesh.position.fromArray(position);
  mesh.quaternion.set(x, y, z, w);
}

function quat({ quaternion: { x, y, z, w } }) {
  return [w, x, y, z];
}
