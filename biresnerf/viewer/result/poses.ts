// Arithmetic on poses: interpolation, distances, fields of view.
import type { Camera, PoseImage } from "schemas";

export type Triple = readonly [number, number, number];
/** Upper three rows of a 4 x 4 matrix; OpenCV axes (x right, y down, z forward), in the input's world. */
export type Matrix = PoseImage["world_from_cam"];
export type Row = Matrix[number];

/** Unit quaternion w, x, y, z. */
type Quaternion = readonly [number, number, number, number];

export const centreOf = (pose: Matrix): Triple => [pose[0][3], pose[1][3], pose[2][3]];

/** Column of the rotation: 0 right, 1 down, 2 forward, in the world. */
export const axisOf = (pose: Matrix, column: 0 | 1 | 2): Triple => [pose[0][column], pose[1][column], pose[2][column]];

export const minus = (a: Triple, b: Triple): Triple => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const plus = (a: Triple, b: Triple): Triple => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const length = (a: Triple): number => Math.hypot(a[0], a[1], a[2]);
const mix = (a: Triple, b: Triple, share: number): Triple => [
  a[0] + share * (b[0] - a[0]),
  a[1] + share * (b[1] - a[1]),
  a[2] + share * (b[2] - a[2]),
];

/** A point in the camera's frame, in the world. */
export const inWorld = (pose: Matrix, p: Triple): Triple => {
  const along = (row: Row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
  return [along(pose[0]), along(pose[1]), along(pose[2])];
};

/** The rotation of a pose, from its largest component: well conditioned for every rotation. */
function quaternionOf(pose: Matrix): Quaternion {
  const [[a, b, c], [d, e, f], [g, h, i]] = pose;
  const parts: readonly [number, Quaternion][] = [
    [1 + a + e + i, [1 + a + e + i, h - f, c - g, d - b]],
    [1 + a - e - i, [h - f, 1 + a - e - i, b + d, c + g]],
    [1 - a + e - i, [c - g, b + d, 1 - a + e - i, f + h]],
    [1 - a - e + i, [d - b, c + g, f + h, 1 - a - e + i]],
  ];
  const best = parts.reduce((x, y) => (y[0] > x[0] ? y : x))[1];
  const size = Math.hypot(...best);
  return [best[0] / size, best[1] / size, best[2] / size, best[3] / size];
}

/** The pose of a rotation and a centre. */
function poseOf([w, x, y, z]: Quaternion, centre: Triple): Matrix {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), centre[0]],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), centre[1]],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), centre[2]],
  ];
}

const dot = (a: Quaternion, b: Quaternion): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];

/** The pose at `share` of the way: the centre on a straight line, the rotation on the shortest arc. */
export function between(first: Matrix, second: Matrix, share: number): Matrix {
  if (share === 0) return first;
  if (share === 1) return second;
  const from = quaternionOf(first);
  let to = quaternionOf(second);
  if (dot(from, to) < 0) to = [-to[0], -to[1], -to[2], -to[3]];
  const cosine = Math.min(1, dot(from, to));
  const angle = Math.acos(cosine);
  const sine = Math.sin(angle);
  // For nearly equal rotations the sines vanish: interpolate linearly.
  const [p, q] =
    sine < 1e-7 ? [1 - share, share] : [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
  const turned: Quaternion = [
    p * from[0] + q * to[0],
    p * from[1] + q * to[1],
    p * from[2] + q * to[2],
    p * from[3] + q * to[3],
  ];
  const size = Math.sqrt(dot(turned, turned));
  return poseOf(
    [turned[0] / size, turned[1] / size, turned[2] / size, turned[3] / size],
    mix(centreOf(first), centreOf(second), share),
  );
}

/** Rotation angle between two poses, degrees; accurate near 0 and near 180. */
export function turnDeg(first: Matrix, second: Matrix): number {
  const a = quaternionOf(first);
  const b = quaternionOf(second);
  const w = dot(a, b);
  const x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
  const y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1];
  const z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0];
  return (2 * Math.atan2(Math.hypot(x, y, z), Math.abs(w)) * 180) / Math.PI;
}

/** Borders of the image at distance 1 in front of the lens: left, top, right, bottom; without distortion. */
export function bordersOf(camera: Omit<Camera, "shear">): [number, number, number, number] {
  const { width, height, params } = camera;
  // COLMAP's models with one focal length have f, cx, cy; the others fx, fy, cx, cy.
  const single = /^(SIMPLE_|RADIAL)/.test(camera.model);
  const fx = params[0] ?? width;
  const fy = (single ? params[0] : params[1]) ?? fx;
  const cx = (single ? params[1] : params[2]) ?? width / 2;
  const cy = (single ? params[2] : params[3]) ?? height / 2;
  return [-cx / fx, -cy / fy, (width - cx) / fx, (height - cy) / fy];
}

/** The median of each coordinate. */
export function medianOf(points: readonly Triple[]): Triple {
  const middle = (axis: 0 | 1 | 2) => {
    const sorted = points.map((p) => p[axis]).sort((a, b) => a - b);
    return sorted[sorted.length >> 1] ?? 0;
  };
  return [middle(0), middle(1), middle(2)];
}

/** Root mean square distance of points from their middle. */
export function spreadOf(points: readonly Triple[], middle: Triple): number {
  const squares = points.map((p) => length(minus(p, middle)) ** 2);
  return Math.sqrt(squares.reduce((a, b) => a + b, 0) / Math.max(1, squares.length));
}
