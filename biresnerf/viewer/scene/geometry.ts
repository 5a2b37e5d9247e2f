// Geometry of the three-dimensional view: the first viewpoint, point clouds, and lines between poses.
import { BufferAttribute, BufferGeometry, Points, PointsMaterial, Vector3 } from "three";
import { axisOf, centreOf, length, minus, type Triple } from "../result/poses";
import type { PointLayer, SceneCamera } from "../result/widget_data";
import type { Colour } from "./colours";
import { srgb } from "./frusta";

/** What to draw. */
export interface Look {
  readonly share: number;
  readonly lines: 0 | 1 | 10;
  readonly before: boolean;
  readonly colours: readonly Colour[];
  readonly beforeColour: Colour;
  readonly selectedColour: Colour;
  readonly selected: number | null;
  readonly layer: PointLayer | null;
  /** How many times too large the uncertainty of the positions is drawn; 0 if it is not. */
  readonly exaggerated: number;
}

export interface Viewpoint {
  readonly at: Triple;
  readonly target: Triple;
}

/** The up direction: the mean of the cameras' up directions. */
export function upwardsOf(cameras: readonly SceneCamera[]): Triple {
  const sum = cameras.reduce<Triple>((total, camera) => minus(total, axisOf(camera.after, 1)), [0, 0, 0]);
  const size = length(sum);
  return size > 1e-3 * cameras.length ? [sum[0] / size, sum[1] / size, sum[2] / size] : [0, 0, 1];
}

/** A viewpoint from the side and slightly above, as near as 98 % of `seen` fit in the view. */
export function overviewOf(
  seen: readonly Vector3[],
  up: Vector3,
  aside: Vector3,
  aspect: number,
  viewDeg: number,
): { at: Vector3; target: Vector3 } {
  const side = aside.clone().addScaledVector(up, -aside.dot(up));
  if (side.lengthSq() < 1e-6) side.set(up.y, up.z, up.x).addScaledVector(up, -side.dot(up));
  side.normalize();
  const from = side.clone().multiplyScalar(0.75).addScaledVector(up, 0.5);
  from.add(new Vector3().crossVectors(up, side).multiplyScalar(0.65)).normalize();
  const right = new Vector3().crossVectors(up, from).normalize();
  const above = new Vector3().crossVectors(from, right);
  const target = new Vector3();
  const slope = 0.94 * Math.tan((viewDeg * Math.PI) / 360);
  let back = Math.max(0.1, 3 * quantile(seen.map((p) => p.length()), 0.98));
  // Near points look larger and lower than far ones, so the middle is found in the projection.
  for (let round = 0; round < 6; round++) {
    const apart = seen.map((p) => p.clone().sub(target));
    const ahead = (off: Vector3) => Math.max(0.05 * back, back - off.dot(from));
    for (const axis of [right, above]) {
      const seenAt = apart.map((off) => off.dot(axis) / ahead(off));
      target.addScaledVector(axis, ((quantile(seenAt, 0.02) + quantile(seenAt, 0.98)) / 2) * back);
    }
    const needed = seen.map((p) => {
      const off = p.clone().sub(target);
      const across = Math.max(Math.abs(off.dot(above)), Math.abs(off.dot(right)) / aspect);
      return off.dot(from) + across / slope;
    });
    back = Math.max(0.1, quantile(needed, 0.98));
  }
  return { at: target.clone().addScaledVector(from, back), target };
}

/** The quantile of some values. */
export function quantile(values: readonly number[], part: number): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(part * (sorted.length - 1))] ?? 0;
}

export function cloudOf(layer: PointLayer): Points {
  const geometry = new BufferGeometry();
  const colours = new Float32Array(layer.colours.length);
  for (let i = 0; i < colours.length; i += 3) {
    colours.set(srgb(layer.colours[i] ?? 0, layer.colours[i + 1] ?? 0, layer.colours[i + 2] ?? 0), i);
  }
  geometry.setAttribute("position", new BufferAttribute(layer.positions, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  const points = new Points(geometry, new PointsMaterial({ size: 2.4, sizeAttenuation: false, vertexColors: true }));
  points.frustumCulled = false;
  return points;
}

/** Segments between pairs of positions. */
export function linesOf(positions: readonly number[], colours: readonly number[]): BufferGeometry {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
  geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
  return geometry;
}

/** Lines from the centres before towards those after, scaled by `look.lines`; in the world minus `origin`. */
export function pathsOf(cameras: readonly SceneCamera[], look: Look, origin: Triple): BufferGeometry {
  const positions: number[] = [];
  const colours: number[] = [];
  cameras.forEach((camera, index) => {
    const colour = look.colours[index];
    if (!camera.before || !colour || look.lines === 0) return;
    const from = centreOf(camera.before);
    const moved = minus(centreOf(camera.after), from);
    const start = minus(from, origin);
    positions.push(...start, ...start.map((value, axis) => value + look.lines * (moved[axis] ?? 0)));
    colours.push(...srgb(...colour), ...srgb(...colour));
  });
  return linesOf(positions, colours);
}
