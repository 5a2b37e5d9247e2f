// How the poses of two results differ, in one frame.
import type { PosesDocument } from "schemas";
import { between, centreOf, length, type Matrix, medianOf, minus, plus, spreadOf, type Triple, turnDeg } from "./poses";

export interface PoseDifference {
  readonly name: string;
  readonly turned_deg: number;
  /** In the first result's units. */
  readonly moved: number;
}

export interface Differences {
  readonly images: readonly PoseDifference[];
  /** Whether the second result had to be moved into the first one's frame: neither started from given poses. */
  readonly aligned: boolean;
}

/** Of the images that both hold, by name. */
export function differencesOf(first: PosesDocument, second: PosesDocument): Differences {
  const others = new Map(second.images.map((image) => [image.name, image]));
  const pairs = first.images.flatMap((image) => {
    const other = others.get(image.name);
    return other ? [{ name: image.name, a: image.world_from_cam, b: other.world_from_cam }] : [];
  });
  const given = ({ images }: PosesDocument) => images.some(({ pose_source }) => pose_source === "given");
  const aligned = !(given(first) && given(second));
  const moved = aligned ? intoFrame(pairs.map(({ a }) => a), pairs.map(({ b }) => b)) : pairs.map(({ b }) => b);
  const images = pairs.map(({ name, a }, index) => {
    const b = moved[index] ?? a;
    return { name, turned_deg: turnDeg(a, b), moved: length(minus(centreOf(b), centreOf(a))) };
  });
  return { images, aligned };
}

/** The second poses in the frame of the first: by the mean rotation between them, their middles and their spreads. */
function intoFrame(first: readonly Matrix[], second: readonly Matrix[]): Matrix[] {
  const turns = second.map((pose, index) => timesInverse(first[index] ?? pose, pose));
  let turn = turns[0];
  if (!turn) return [];
  turns.slice(1).forEach((next, index) => (turn = between(turn!, next, 1 / (index + 2))));
  const [a, b] = [medianOf(first.map(centreOf)), medianOf(second.map(centreOf))];
  const scale = spreadOf(first.map(centreOf), a) / Math.max(1e-12, spreadOf(second.map(centreOf), b));
  return second.map((pose) => {
    const off = minus(centreOf(pose), b);
    const turned = rotated(turn!, off);
    const centre = plus(a, [scale * turned[0], scale * turned[1], scale * turned[2]]);
    const columns = ([0, 1, 2] as const).map((column) => rotated(turn!, [pose[0][column], pose[1][column], pose[2][column]]));
    const row = (axis: 0 | 1 | 2) => [columns[0]![axis], columns[1]![axis], columns[2]![axis], centre[axis]] as const;
    return [row(0), row(1), row(2)];
  });
}

/** The rotation from the second pose's world to the first one's, as a pose without a place. */
function timesInverse(a: Matrix, b: Matrix): Matrix {
  const entry = (i: 0 | 1 | 2, j: 0 | 1 | 2) => a[i][0] * b[j][0] + a[i][1] * b[j][1] + a[i][2] * b[j][2];
  const row = (i: 0 | 1 | 2) => [entry(i, 0), entry(i, 1), entry(i, 2), 0] as const;
  return [row(0), row(1), row(2)];
}

const rotated = (turn: Matrix, [x, y, z]: Triple): Triple => [
  turn[0][0] * x + turn[0][1] * y + turn[0][2] * z,
  turn[1][0] * x + turn[1][1] * y + turn[1][2] * z,
  turn[2][0] * x + turn[2][1] * y + turn[2][2] * z,
];
