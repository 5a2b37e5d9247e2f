// The three-dimensional picture itself: what is drawn, from where it is seen, what lies under the pointer.
import {
  BufferAttribute,
  BufferGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  type MeshBasicMaterial,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Scene,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Colour } from "./colours";
import { Frusta, srgb, VERTICES } from "./frusta";
import { axisOf, between, centreOf, length, medianOf, minus, spreadOf } from "./poses";
import type { Matrix, PointLayer, SceneCamera, Triple } from "./types";

const VIEW_DEG = 45;
const PICK_PX = 14;
const FLIGHT_MS = 350;

export interface Look {
  readonly share: number;
  readonly lines: 0 | 1 | 10;
  readonly before: boolean;
  readonly colours: readonly Colour[];
  readonly beforeColour: Colour;
  readonly selectedColour: Colour;
  readonly selected: number | null;
  readonly layer: PointLayer | null;
}

export class SceneDrawing {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly world = new Group();
  private readonly eye = new PerspectiveCamera(VIEW_DEG, 1, 0.001, 1000);
  private readonly controls: OrbitControls;
  private readonly before: Frusta;
  private readonly after: Frusta;
  private readonly chosen: Frusta;
  private readonly chosenSides: Mesh;
  private readonly paths: LineSegments;
  private points: Points | null = null;
  private layer: PointLayer | null = null;
  private look: Look | null = null;
  private flight = 0;
  private frame = 0;
  private through: number | null = null;
  readonly origin: Triple;
  readonly spread: number;

  /** Throws where the browser has no WebGL. */
  constructor(
    host: HTMLElement,
    private readonly cameras: readonly SceneCamera[],
    private readonly onLeave: () => void,
  ) {
    const centres = cameras.map((camera) => centreOf(camera.after));
    this.origin = medianOf(centres);
    this.spread = Math.max(spreadOf(centres, this.origin), 1e-12);
    const depth = (0.9 * this.spread) / Math.sqrt(Math.max(4, cameras.length));
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    host.append(this.renderer.domElement);
    this.renderer.domElement.setAttribute("aria-hidden", "true");

    this.before = new Frusta(cameras, depth, this.origin, 0.75);
    this.after = new Frusta(cameras, depth, this.origin, 1);
    this.chosen = new Frusta(cameras.slice(0, 1), 1.3 * depth, this.origin, 1);
    this.chosenSides = this.chosen.filled(0.3);
    this.paths = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ vertexColors: true }));
    this.paths.frustumCulled = false;
    for (const [index, camera] of cameras.entries()) {
      this.after.place(index, camera.after);
      if (camera.before) this.before.place(index, camera.before);
      else this.before.hide(index);
    }
    // Drawn at a size of about one, whatever the input's unit: depth buffers have few digits.
    this.world.scale.setScalar(1 / this.spread);
    this.world.add(this.before.lines, this.after.lines, this.paths, this.chosen.lines, this.chosenSides);
    this.chosen.lines.renderOrder = 2;
    this.scene.add(this.world);

    const up = this.upwards();
    this.eye.up.set(...up);
    this.controls = new OrbitControls(this.eye, this.renderer.domElement);
    this.controls.addEventListener("change", this.draw);
    this.controls.addEventListener("start", this.leave);
    this.overview(false);
  }

  /** Which way is up: where most pictures have their top. */
  private upwards(): Triple {
    const sum = this.cameras.reduce<Triple>((total, camera) => minus(total, axisOf(camera.after, 1)), [0, 0, 0]);
    const size = length(sum);
    return size > 1e-3 * this.cameras.length ? [sum[0] / size, sum[1] / size, sum[2] / size] : [0, 0, 1];
  }

  /** Everything from aside and a little above. */
  overview(animated: boolean): void {
    const up = this.eye.up.clone();
    const side = new Vector3(...axisOf(this.cameras[0]?.after ?? IDENTITY, 0));
    side.addScaledVector(up, -side.dot(up));
    if (side.lengthSq() < 1e-6) side.set(1, 0, 0);
    side.normalize();
    const from = side.clone().multiplyScalar(0.75).addScaledVector(up, 0.5);
    from.add(new Vector3().crossVectors(up, side).multiplyScalar(0.65)).normalize();
    const right = new Vector3().crossVectors(up, from).normalize();
    const above = new Vector3().crossVectors(from, right);
    const seen = this.shownPoints();
    const middle = (axis: Vector3): number => {
      const along = seen.map((p) => p.dot(axis)).sort((a, b) => a - b);
      const cut = Math.floor(0.02 * along.length);
      return ((along[cut] ?? 0) + (along[along.length - 1 - cut] ?? 0)) / 2;
    };
    const target = new Vector3().addScaledVector(right, middle(right)).addScaledVector(above, middle(above));
    target.addScaledVector(from, middle(from));
    // As near as all fit but a few strays.
    const slope = 0.94 * Math.tan((VIEW_DEG * Math.PI) / 360);
    const needed = seen.map((p) => {
      const off = p.clone().sub(target);
      const across = Math.max(Math.abs(off.dot(above)), Math.abs(off.dot(right)) / (this.eye.aspect || 1));
      return off.dot(from) + across / slope;
    });
    needed.sort((a, b) => a - b);
    const back = Math.max(0.1, needed[Math.floor(0.98 * (needed.length - 1))] ?? 1);
    this.fly(target.clone().addScaledVector(from, back), target, VIEW_DEG, animated);
  }

  /** Corners of all cameras before and after, in drawn units. */
  private shownPoints(): Vector3[] {
    const all: Vector3[] = [];
    this.cameras.forEach((camera, index) => {
      for (const vertex of [0, 1, 3]) {
        all.push(new Vector3(...this.after.drawn(index, vertex)).divideScalar(this.spread));
        if (camera.before) all.push(new Vector3(...this.before.drawn(index, vertex)).divideScalar(this.spread));
      }
    });
    return all;
  }

  /** The picture as a camera took it; the next touch of the controls leaves it. */
  lookThrough(index: number, animated: boolean): void {
    const camera = this.cameras[index];
    if (!camera) return;
    const pose = this.poseAt(camera);
    const [left, top, right, bottom] = camera.borders;
    const high = 2 * Math.atan(Math.max(-top, bottom, Math.max(-left, right) / (this.eye.aspect || 1)));
    const at = this.drawnPoint(centreOf(pose));
    const ahead = new Vector3(...axisOf(pose, 2));
    this.fly(at, at.clone().add(ahead), Math.min(120, (1.1 * high * 180) / Math.PI), animated, pose);
    this.through = index;
    this.hideInside();
  }

  /** From within, the drawing of the camera itself would be in the way. */
  private hideInside(): void {
    if (this.look) this.choose(this.look);
    this.draw();
  }

  private readonly leave = (): void => {
    cancelAnimationFrame(this.flight);
    if (this.through === null) return;
    this.through = null;
    this.eye.fov = VIEW_DEG;
    this.eye.updateProjectionMatrix();
    this.onLeave();
    this.hideInside();
  };

  private fly(to: Vector3, target: Vector3, fov: number, animated: boolean, pose?: Matrix): void {
    cancelAnimationFrame(this.flight);
    this.through = null;
    const from = { at: this.eye.position.clone(), target: this.controls.target.clone(), fov: this.eye.fov };
    const began = performance.now();
    const step = (now: number): void => {
      const share = animated ? Math.min(1, (now - began) / FLIGHT_MS) : 1;
      const eased = share * share * (3 - 2 * share);
      this.eye.position.lerpVectors(from.at, to, eased);
      this.controls.target.lerpVectors(from.target, target, eased);
      this.eye.fov = from.fov + eased * (fov - from.fov);
      this.eye.updateProjectionMatrix();
      this.controls.update();
      if (share === 1 && pose) this.turnAs(pose);
      this.draw();
      if (share < 1) this.flight = requestAnimationFrame(step);
    };
    if (animated) this.flight = requestAnimationFrame(step);
    else step(began);
  }

  /** Photos lie askew at times, which orbiting cannot: the eye turns as the camera was. */
  private turnAs(pose: Matrix): void {
    const [x, y, z] = [axisOf(pose, 0), axisOf(pose, 1), axisOf(pose, 2)];
    this.eye.matrix.makeBasis(new Vector3(...x), new Vector3(...y).negate(), new Vector3(...z).negate());
    this.eye.quaternion.setFromRotationMatrix(this.eye.matrix);
  }

  private drawnPoint(p: Triple): Vector3 {
    return new Vector3(...minus(p, this.origin)).divideScalar(this.spread);
  }

  private poseAt(camera: SceneCamera): Matrix {
    return camera.before ? between(camera.before, camera.after, this.look?.share ?? 1) : camera.after;
  }

  /** Shows what a look says. */
  show(look: Look): void {
    const last = this.look;
    this.look = look;
    if (last?.share !== look.share) {
      this.cameras.forEach((camera, index) => this.after.place(index, this.poseAt(camera)));
    }
    if (last?.colours !== look.colours) {
      look.colours.forEach((colour, index) => {
        this.after.paint(index, colour);
      });
    }
    if (last?.beforeColour !== look.beforeColour) {
      this.cameras.forEach((_, index) => this.before.paint(index, look.beforeColour));
    }
    this.before.lines.visible = look.before;
    this.choose(look);
    if (last?.lines !== look.lines || last.colours !== look.colours) this.drawPaths(look);
    if (this.layer !== look.layer) this.drawPoints(look.layer);
    if (this.through !== null && last?.share !== look.share) this.lookThrough(this.through, false);
    this.draw();
  }

  private choose(look: Look): void {
    const camera = look.selected === null ? undefined : this.cameras[look.selected];
    const visible = camera !== undefined && this.through === null;
    this.chosen.lines.visible = this.chosenSides.visible = visible;
    if (!camera) return;
    this.chosen.become(camera);
    this.chosen.place(0, this.poseAt(camera));
    this.chosen.paint(0, look.selectedColour);
  }

  private drawPaths(look: Look): void {
    this.paths.visible = look.lines > 0;
    const positions: number[] = [];
    const colours: number[] = [];
    this.cameras.forEach((camera, index) => {
      const colour = look.colours[index];
      if (!camera.before || !colour || look.lines === 0) return;
      const from = centreOf(camera.before);
      const moved = minus(centreOf(camera.after), from);
      const start = minus(from, this.origin);
      positions.push(...start);
      positions.push(...start.map((value, axis) => value + look.lines * (moved[axis] ?? 0)));
      colours.push(...srgb(...colour), ...srgb(...colour));
    });
    this.paths.geometry.dispose();
    this.paths.geometry = new BufferGeometry();
    this.paths.geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
    this.paths.geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
  }

  private drawPoints(layer: PointLayer | null): void {
    this.layer = layer;
    if (this.points) {
      this.world.remove(this.points);
      this.points.geometry.dispose();
      (this.points.material as PointsMaterial).dispose();
      this.points = null;
    }
    if (!layer) return;
    const geometry = new BufferGeometry();
    const colours = new Float32Array(layer.colours.length);
    for (let i = 0; i < colours.length; i += 3) {
      colours.set(srgb(layer.colours[i] ?? 0, layer.colours[i + 1] ?? 0, layer.colours[i + 2] ?? 0), i);
    }
    geometry.setAttribute("position", new BufferAttribute(layer.positions, 3));
    geometry.setAttribute("color", new BufferAttribute(colours, 3));
    const material = new PointsMaterial({ size: 2.4, sizeAttenuation: false, vertexColors: true });
    this.points = new Points(geometry, material);
    this.points.position.set(...minus(layer.origin, this.origin));
    this.points.frustumCulled = false;
    this.world.add(this.points);
  }

  /** Size in CSS pixels. */
  resize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    const first = !this.renderer.domElement.style.width;
    this.renderer.setSize(width, height);
    this.eye.aspect = width / height;
    this.eye.updateProjectionMatrix();
    if (first) this.overview(false);
    this.draw();
  }

  /** The camera nearest to a point of the page, if one is near. */
  pick(clientX: number, clientY: number): number | null {
    const box = this.renderer.domElement.getBoundingClientRect();
    let best = PICK_PX;
    let found: number | null = null;
    const at = new Vector3();
    this.world.updateMatrixWorld();
    this.cameras.forEach((_, index) => {
      for (let vertex = 0; vertex < VERTICES - 1; vertex++) {
        at.set(...this.after.drawn(index, vertex)).applyMatrix4(this.world.matrixWorld).project(this.eye);
        if (at.z > 1 || at.z < -1) continue;
        const x = box.left + ((at.x + 1) / 2) * box.width;
        const y = box.top + ((1 - at.y) / 2) * box.height;
        const apart = Math.hypot(x - clientX, y - clientY);
        if (apart < best) [best, found] = [apart, index];
      }
    });
    return found;
  }

  /** Where a camera's centre is drawn, in the world: read back from what the GPU was given. */
  drawnCentre(index: number): Triple {
    const [x, y, z] = this.after.drawn(index, 0);
    return [x + this.origin[0], y + this.origin[1], z + this.origin[2]];
  }

  /** Where a camera's centre lies on the page, CSS pixels of the drawing. */
  onScreen(index: number): [number, number] {
    this.world.updateMatrixWorld();
    const at = new Vector3(...this.after.drawn(index, 0)).applyMatrix4(this.world.matrixWorld).project(this.eye);
    const box = this.renderer.domElement.getBoundingClientRect();
    return [((at.x + 1) / 2) * box.width, ((1 - at.y) / 2) * box.height];
  }

  /** At the next frame, once: nothing is drawn while nothing changes. */
  private readonly draw = (): void => {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.renderer.render(this.scene, this.eye);
    });
  };

  dispose(): void {
    cancelAnimationFrame(this.frame);
    cancelAnimationFrame(this.flight);
    this.controls.dispose();
    this.drawPoints(null);
    for (const drawn of [this.before, this.after, this.chosen]) drawn.dispose();
    this.chosenSides.geometry.dispose();
    (this.chosenSides.material as MeshBasicMaterial).dispose();
    this.paths.geometry.dispose();
    (this.paths.material as LineBasicMaterial).dispose();
    this.renderer.dispose();
    this.renderer.domElement.remove();
  }
}

const IDENTITY: Matrix = [
  [1, 0, 0, 0],
  [0, 1, 0, 0],
  [0, 0, 1, 0],
];
