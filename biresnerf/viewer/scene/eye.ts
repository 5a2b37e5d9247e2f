// The viewer's eye in the three-dimensional view: where it is, how the pointer moves it, and its flights.
import { PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { axisOf, type Matrix, type Triple } from "../result/poses";

export const VIEW_DEG = 45;
const FLIGHT_MS = 350;

export class Eye {
  readonly camera = new PerspectiveCamera(VIEW_DEG, 1, 0.001, 1000);
  readonly controls: OrbitControls;
  private flight = 0;

  constructor(
    element: HTMLElement,
    up: Triple,
    private readonly onMoved: () => void,
    onTaken: () => void,
  ) {
    this.camera.up.set(...up);
    this.controls = new OrbitControls(this.camera, element);
    this.controls.addEventListener("change", onMoved);
    this.controls.addEventListener("start", onTaken);
  }

  get up(): Vector3 {
    return this.camera.up;
  }

  set aspect(value: number) {
    this.camera.aspect = value;
    this.camera.updateProjectionMatrix();
  }

  /** Moves to a place; with `pose` it ends rolled as that camera is. */
  fly(to: Vector3, target: Vector3, fov: number, animated: boolean, pose?: Matrix): void {
    this.stop();
    const from = { at: this.camera.position.clone(), target: this.controls.target.clone(), fov: this.camera.fov };
    const began = performance.now();
    const step = (now: number): void => {
      const share = animated ? Math.min(1, (now - began) / FLIGHT_MS) : 1;
      const eased = share * share * (3 - 2 * share);
      this.camera.position.lerpVectors(from.at, to, eased);
      this.controls.target.lerpVectors(from.target, target, eased);
      this.camera.fov = from.fov + eased * (fov - from.fov);
      this.camera.updateProjectionMatrix();
      this.controls.update();
      if (share === 1 && pose) this.rollTo(pose);
      this.onMoved();
      if (share < 1) this.flight = requestAnimationFrame(step);
    };
    if (animated) this.flight = requestAnimationFrame(step);
    else step(began);
  }

  /** Rolls the view with the camera, which orbit controls cannot. */
  private rollTo(pose: Matrix): void {
    const [x, y, z] = [axisOf(pose, 0), axisOf(pose, 1), axisOf(pose, 2)];
    this.camera.matrix.makeBasis(new Vector3(...x), new Vector3(...y).negate(), new Vector3(...z).negate());
    this.camera.quaternion.setFromRotationMatrix(this.camera.matrix);
  }

  /** Sees as widely as in an overview. */
  widen(): void {
    this.camera.fov = VIEW_DEG;
    this.camera.updateProjectionMatrix();
  }

  /** Ends a flight where it is. */
  stop(): void {
    cancelAnimationFrame(this.flight);
  }

  dispose(): void {
    this.stop();
    this.controls.dispose();
  }
}
