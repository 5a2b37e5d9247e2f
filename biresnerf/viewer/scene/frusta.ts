// Camera frusta as lines, all in one buffer: hundreds cost one draw call.
import {
  BufferAttribute,
  BufferGeometry,
  DoubleSide,
  DynamicDrawUsage,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
} from "three";
import { inWorld, type Matrix, type Triple } from "../result/poses";
import type { SceneCamera } from "../result/widget_data";
import type { Colour } from "./colours";

// Vertices: the centre 0, the picture's corners 1 to 4 from its top left, and a tip 5 above its top edge.
const SIDES = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1, 1, 2, 3, 1, 3, 4];
const EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1, 1, 5, 5, 2];
export const VERTICES = 6;

/** Corners of a frustum in the camera's frame, `depth` in front of the lens. */
function cornersOf(camera: SceneCamera, depth: number): Triple[] {
  const [left, top, right, bottom] = camera.borders;
  const tip = top - 0.35 * (bottom - top);
  const flat: [number, number][] = [
    [left, top],
    [right, top],
    [right, bottom],
    [left, bottom],
    [(left + right) / 2, tip],
  ];
  return [[0, 0, 0], ...flat.map(([x, y]): Triple => [depth * x, depth * y, depth])];
}

export class Frusta {
  readonly lines: LineSegments;
  private readonly positions: BufferAttribute;
  private readonly colours: BufferAttribute;
  private readonly corners: Triple[][];

  constructor(
    cameras: readonly SceneCamera[],
    private readonly depth: number,
    private readonly origin: Triple,
    opacity: number,
  ) {
    this.corners = cameras.map((camera) => cornersOf(camera, depth));
    const geometry = new BufferGeometry();
    this.positions = new BufferAttribute(new Float32Array(cameras.length * VERTICES * 3), 3);
    this.colours = new BufferAttribute(new Float32Array(cameras.length * VERTICES * 3), 3);
    this.positions.setUsage(DynamicDrawUsage);
    geometry.setAttribute("position", this.positions);
    geometry.setAttribute("color", this.colours);
    geometry.setIndex(cameras.flatMap((_, i) => EDGES.map((vertex) => vertex + i * VERTICES)));
    const material = new LineBasicMaterial({ vertexColors: true, transparent: opacity < 1, opacity });
    this.lines = new LineSegments(geometry, material);
    this.lines.frustumCulled = false;
  }

  /** Gives camera 0 the shape of another one. */
  become(camera: SceneCamera): void {
    this.corners[0] = cornersOf(camera, this.depth);
  }

  /** The sides of camera 0, filled. */
  filled(opacity: number): Mesh {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.positions);
    geometry.setAttribute("color", this.colours);
    geometry.setIndex(SIDES);
    const side = DoubleSide;
    const material = new MeshBasicMaterial({ vertexColors: true, transparent: true, opacity, side, depthWrite: false });
    const mesh = new Mesh(geometry, material);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** Moves a camera to `pose`. The origin is subtracted in double precision, for worlds far from zero. */
  place(index: number, pose: Matrix): void {
    this.corners[index]?.forEach((corner, vertex) => {
      const [x, y, z] = inWorld(pose, corner);
      const at = index * VERTICES + vertex;
      this.positions.setXYZ(at, x - this.origin[0], y - this.origin[1], z - this.origin[2]);
    });
    this.positions.needsUpdate = true;
  }

  /** Hides a camera: all its vertices in one place. */
  hide(index: number): void {
    for (let vertex = 0; vertex < VERTICES; vertex++) this.positions.setXYZ(index * VERTICES + vertex, 0, 0, 0);
    this.positions.needsUpdate = true;
  }

  paint(index: number, [r, g, b]: Colour): void {
    const colour = srgb(r, g, b);
    for (let vertex = 0; vertex < VERTICES; vertex++) this.colours.setXYZ(index * VERTICES + vertex, ...colour);
    this.colours.needsUpdate = true;
  }

  /** A vertex as it is drawn, relative to the origin. */
  drawn(index: number, vertex: number): Triple {
    const at = index * VERTICES + vertex;
    return [this.positions.getX(at), this.positions.getY(at), this.positions.getZ(at)];
  }

  dispose(): void {
    this.lines.geometry.dispose();
    (this.lines.material as LineBasicMaterial).dispose();
  }
}

/** sRGB (0 to 255) to the linear light (0 to 1) that three.js takes. */
export function srgb(r: number, g: number, b: number): [number, number, number] {
  const linear = (value: number) => (value <= 10.31475 ? value / 3294.6 : ((value / 255 + 0.055) / 1.055) ** 2.4);
  return [linear(r), linear(g), linear(b)];
}
