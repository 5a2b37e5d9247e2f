// The three-dimensional view: its objects, its viewpoint, and which camera is under the pointer.
import {
  BufferGeometry, Group, LineBasicMaterial, LineSegments, Mesh, type MeshBasicMaterial, type Points, type PointsMaterial,
  Scene, Vector3, WebGLRenderer,
} from "three";
import { axisOf, between, centreOf, type Matrix, medianOf, minus, plus, spreadOf, type Triple } from "../result/poses";
import type { PointLayer, SceneCamera } from "../result/widget_data";
import { Ellipsoids } from "./ellipsoids";
import { Eye, VIEW_DEG } from "./eye";
import { Frusta, VERTICES } from "./frusta";
import { cloudOf, gridBelow, type Look, nearPoints, overviewOf, pathsOf, upwardsOf, type Viewpoint } from "./geometry";
import { Photos } from "./photo_planes";

const PICK_PX = 14;

export class SceneDrawing {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly world = new Group();
  private readonly eye: Eye;
  private readonly before: Frusta;
  private readonly after: Frusta;
  private readonly chosen: Frusta;
  private readonly chosenSides: Mesh;
  private readonly paths: LineSegments;
  private readonly ellipsoids: Ellipsoids;
  private readonly photos: Photos;
  private grid: LineSegments | null = null;
  private points: Points | null = null;
  private layer: PointLayer | null = null;
  private look: Look | null = null;
  private frame = 0;
  private through: number | null = null;
  private placed = false;
  /** Whether the user has turned the view: it then stays where it is. */
  private touched = false;
  readonly origin: Triple;
  readonly spread: number;

  /** Throws if the browser has no WebGL. */
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
    this.ellipsoids = new Ellipsoids(cameras, this.origin);
    this.photos = new Photos(cameras, this.draw);
    for (const [index, camera] of cameras.entries()) {
      this.after.place(index, camera.after);
      if (camera.before) this.before.place(index, camera.before);
      else this.before.hide(index);
    }
    // Scaled to a size of about one, whatever the input's unit: depth buffers have few digits.
    this.world.scale.setScalar(1 / this.spread);
    this.world.add(this.before.lines, this.after.lines, this.paths, this.ellipsoids.lines, this.chosen.lines, this.chosenSides);
    this.world.add(...this.photos.meshes);
    this.photos.follow(this.after);
    this.chosen.lines.renderOrder = 2;
    this.scene.add(this.world);

    this.eye = new Eye(this.renderer.domElement, upwardsOf(cameras), this.draw, this.leave);
    this.overview(false);
  }

  /** Shows everything, from the side and slightly above. */
  overview(animated: boolean): void {
    const side = new Vector3(...(this.cameras[0] ? axisOf(this.cameras[0].after, 0) : [1, 0, 0]));
    const { at, target } = overviewOf([...this.shownPoints(), ...this.scenePoints()], this.eye.up, side, this.eye.camera.aspect || 1, VIEW_DEG);
    this.through = null;
    this.eye.fly(at, target, VIEW_DEG, animated);
    this.updateSelected();
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

  /** Some points of the scene in drawn units, without the far ones. */
  private scenePoints(): Vector3[] {
    return this.layer ? nearPoints(this.layer, (at) => this.drawnPoint(at)) : [];
  }

  /** Looks through a camera, until the controls are used. */
  lookThrough(index: number, animated: boolean): void {
    const camera = this.cameras[index];
    if (!camera) return;
    const pose = this.poseAt(camera);
    const [left, top, right, bottom] = camera.borders;
    const high = 2 * Math.atan(Math.max(-top, bottom, Math.max(-left, right) / (this.eye.camera.aspect || 1)));
    const at = this.drawnPoint(centreOf(pose));
    const ahead = new Vector3(...axisOf(pose, 2));
    this.eye.fly(at, at.clone().add(ahead), Math.min(120, (1.1 * high * 180) / Math.PI), animated, pose);
    this.through = index;
    this.updateSelected();
  }

  /** Hides the selected camera while looking through it: it would be in the way. */
  private updateSelected(): void {
    if (this.look) this.choose(this.look);
    this.draw();
  }

  private readonly leave = (): void => {
    this.touched = true;
    this.eye.stop();
    if (this.through === null) return;
    this.through = null;
    this.eye.widen();
    this.onLeave();
    this.updateSelected();
  };

  private drawnPoint(p: Triple): Vector3 {
    return new Vector3(...minus(p, this.origin)).divideScalar(this.spread);
  }

  private poseAt(camera: SceneCamera): Matrix {
    return camera.before ? between(camera.before, camera.after, this.look?.share ?? 1) : camera.after;
  }

  /** Draws with these settings; only what has changed is updated. */
  show(look: Look): void {
    const last = this.look;
    this.look = look;
    if (last?.share !== look.share) {
      this.cameras.forEach((camera, index) => this.after.place(index, this.poseAt(camera)));
      this.photos.follow(this.after);
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
    if (last?.lines !== look.lines || last.colours !== look.colours) {
      this.paths.geometry.dispose();
      this.paths.geometry = pathsOf(this.cameras, look, this.origin);
    }
    if (last?.exaggerated !== look.exaggerated || last.colours !== look.colours) this.ellipsoids.show(look);
    if (this.layer !== look.layer) this.drawPoints(look.layer);
    if (last?.gridColour !== look.gridColour) this.drawGrid(look);
    if (this.through !== null && last?.share !== look.share) this.lookThrough(this.through, false);
    this.draw();
  }

  private drawGrid(look: Look): void {
    if (this.grid) {
      this.grid.removeFromParent().geometry.dispose();
      (this.grid.material as LineBasicMaterial).dispose();
    }
    this.grid = gridBelow([...this.shownPoints(), ...this.scenePoints()], this.eye.up, look.gridColour);
    this.scene.add(this.grid);
  }

  private choose(look: Look): void {
    const camera = look.selected === null ? undefined : this.cameras[look.selected];
    const visible = camera !== undefined && this.through === null;
    this.chosen.lines.visible = this.chosenSides.visible = visible;
    if (!camera) return this.photos.show(look, null, this.chosen);
    this.chosen.become(camera);
    this.chosen.place(0, this.poseAt(camera));
    this.chosen.paint(0, look.selectedColour);
    this.photos.show(look, this.through, this.chosen);
  }

  private drawPoints(layer: PointLayer | null): void {
    this.layer = layer;
    if (this.points) {
      this.points.removeFromParent().geometry.dispose();
      (this.points.material as PointsMaterial).dispose();
      this.points = null;
    }
    if (!layer) return;
    this.points = cloudOf(layer);
    this.points.position.set(...minus(layer.origin, this.origin));
    this.world.add(this.points);
    if (this.look) this.drawGrid(this.look);
    if (!this.touched && this.through === null) this.overview(false);
  }

  /** Size in CSS pixels. */
  resize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    this.eye.aspect = width / height;
    if (!this.placed) this.overview(false);
    this.placed = true;
    this.draw();
  }

  /** The camera nearest to a point of the page, or null if none is near. */
  pick(clientX: number, clientY: number): number | null {
    const box = this.renderer.domElement.getBoundingClientRect();
    let best = PICK_PX;
    let found: number | null = null;
    this.cameras.forEach((_, index) => {
      for (let vertex = 0; vertex < VERTICES - 1; vertex++) {
        const seen = this.onScreen(index, vertex);
        const apart = seen ? Math.hypot(seen[0] + box.left - clientX, seen[1] + box.top - clientY) : best;
        if (apart < best) [best, found] = [apart, index];
      }
    });
    return found;
  }

  /** Position of a vertex in the view, CSS pixels; null if it is behind the viewer. */
  onScreen(index: number, vertex: number): [number, number] | null {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    this.eye.camera.updateMatrixWorld();
    const at = new Vector3(...this.after.drawn(index, vertex)).divideScalar(this.spread).project(this.eye.camera);
    return Math.abs(at.z) > 1 ? null : [((at.x + 1) / 2) * clientWidth, ((1 - at.y) / 2) * clientHeight];
  }

  /** A camera's centre as drawn, in the world: read back from the buffer of the GPU. */
  drawnCentre(index: number): Triple {
    return plus(this.after.drawn(index, 0), this.origin);
  }

  /** Points on a camera's ellipsoid as drawn, in the world. */
  drawnUncertainty(index: number): Triple[] {
    return this.ellipsoids.drawn(index).map((at) => plus(at, this.origin));
  }

  /** The viewpoint in the world, to restore it in another drawing. */
  viewpoint(): Viewpoint {
    const inWorld = (p: Vector3) => plus(p.clone().multiplyScalar(this.spread).toArray(), this.origin);
    return { at: inWorld(this.eye.camera.position), target: inWorld(this.eye.controls.target) };
  }

  setViewpoint({ at, target }: Viewpoint): void {
    this.placed = this.touched = true;
    this.eye.fly(this.drawnPoint(at), this.drawnPoint(target), VIEW_DEG, false);
  }

  /** Draws at the next frame, once. */
  private readonly draw = (): void => {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.renderer.render(this.scene, this.eye.camera);
    });
  };

  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.eye.dispose();
    this.drawPoints(null);
    for (const drawn of [this.before, this.after, this.chosen, this.ellipsoids, this.photos]) drawn.dispose();
    this.grid?.geometry.dispose();
    (this.grid?.material as LineBasicMaterial | undefined)?.dispose();
    this.chosenSides.geometry.dispose();
    (this.chosenSides.material as MeshBasicMaterial).dispose();
    this.paths.geometry.dispose();
    (this.paths.material as LineBasicMaterial).dispose();
    this.renderer.dispose();
    this.renderer.domElement.remove();
  }
}
