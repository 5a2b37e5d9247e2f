// Geometry of the three-dimensional view: the first viewpoint, point clouds, and lines between poses.
import { BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments, Points, PointsMaterial, Vector3 } from "three";
import { axisOf, centreOf, length, minus, type Triple } from "../result/poses";
import type { PointLayer, SceneCamera, SheetCell } from "../result/widget_data";
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
  readonly gridColour: Colour;
  /** Whether photos are shown in the frusta, cut from the contact sheet. */
  readonly photos: boolean;
  readonly cellOf: (image: number) => SheetCell | null;
  /** A photo's own picture, larger than in the contact sheet, if there is one. */
  readonly photoOf: (image: number) => string | null;
  /** Opacity of the photo over the view through its camera. */
  readonly overlay: number;
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

// Of the scene, to find the first view: so many points, without the farthest.
const POINTS_FRAMED = 300;
const NEAR_SHARE = 0.8;

/** Some of a layer's points as `drawn`, without the far ones. */
export function nearPoints({ positions, origin }: PointLayer, drawn: (at: Triple) => Vector3): Vector3[] {
  const every = 3 * Math.max(1, Math.floor(positions.length / 3 / POINTS_FRAMED));
  const some: Vector3[] = [];
  for (let i = 0; i + 2 < positions.length; i += every) {
    some.push(drawn([origin[0] + (positions[i] ?? 0), origin[1] + (positions[i + 1] ?? 0), origin[2] + (positions[i + 2] ?? 0)]));
  }
  const far = quantile(some.map((point) => point.length()), NEAR_SHARE);
  return some.filter((point) => point.length() <= far);
}

const GRID_LINES = 10; // on each side of the middle

/** A level grid below what is seen, in drawn units. */
export function gridBelow(seen: readonly Vector3[], up: Vector3, [r, g, b]: Colour): LineSegments {
  const middle = seen.reduce((sum, point) => sum.add(point), new Vector3()).divideScalar(Math.max(1, seen.length));
  const lowest = quantile(seen.map((point) => point.dot(up)), 0.02);
  const reach = 1.3 * quantile(seen.map((point) => point.distanceTo(middle)), 0.98);
  middle.addScaledVector(up, lowest - middle.dot(up));
  const along = new Vector3(up.y, up.z, up.x).addScaledVector(up, -(up.y * up.x + up.z * up.y + up.x * up.z)).normalize();
  const across = new Vector3().crossVectors(up, along);
  const positions: number[] = [];
  for (let line = -GRID_LINES; line <= GRID_LINES; line++) {
    for (const [one, other] of [[along, across], [across, along]] as const) {
      for (const end of [-1, 1]) {
        const at = middle.clone().addScaledVector(one, (line / GRID_LINES) * reach).addScaledVector(other, end * reach);
        positions.push(at.x, at.y, at.z);
      }
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
  const material = new LineBasicMaterial({ transparent: true, opacity: 0.5, depthWrite: false });
  material.color.setRGB(...srgb(r, g, b));
  return new LineSegments(geometry, material);
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
