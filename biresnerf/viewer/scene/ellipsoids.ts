// Ellipsoids of the cameras' uncertain positions as lines, all in one buffer.
import { BufferGeometry, LineBasicMaterial, LineSegments } from "three";
import { centreOf, minus, type Triple } from "../result/poses";
import type { SceneCamera } from "../result/widget_data";
import { srgb } from "./frusta";
import { type Look, linesOf, quantile } from "./geometry";

// The squared length that 90 % of normal deviates in three dimensions stay below, per axis: chi square with 3 degrees.
const CHI_SQUARE_90 = 6.2514;
const CORNERS = 24; // of a circle

/** By how much to exaggerate ellipsoids so that the median one is about as large as `size`: a power of ten, 1 at least. */
export function exaggerationOf(cameras: readonly SceneCamera[], size: number): number {
  const bounds = cameras.flatMap((camera) => camera.uncertainty?.position ?? []);
  const median = quantile(bounds, 0.5);
  return median > 0 ? 10 ** Math.max(0, Math.floor(Math.log10(size / median))) : 1;
}

/** Columns of L with L L^T a positive definite matrix, the lower right block of a covariance. */
function rootOf(covariance: readonly (readonly number[])[]): readonly [Triple, Triple, Triple] {
  const at = (row: number, column: number) => covariance[3 + row]?.[3 + column] ?? 0;
  const a = Math.sqrt(Math.max(at(0, 0), 0)) || 1e-300;
  const [b, c] = [at(1, 0) / a, at(2, 0) / a];
  const d = Math.sqrt(Math.max(at(1, 1) - b * b, 0)) || 1e-300;
  const e = (at(2, 1) - b * c) / d;
  const f = Math.sqrt(Math.max(at(2, 2) - c * c - e * e, 0));
  return [
    [a, b, c],
    [0, d, e],
    [0, 0, f],
  ];
}

/** Each holds 90 % of the errors of its camera's position, around the returned pose. */
export class Ellipsoids {
  readonly lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ vertexColors: true }));
  /** Where each camera's vertices begin; null without ellipsoid. */
  private readonly first: (number | null)[];

  constructor(
    private readonly cameras: readonly SceneCamera[],
    private readonly origin: Triple,
  ) {
    let next = 0;
    this.first = cameras.map((camera) => (camera.uncertainty?.covariance ? 6 * CORNERS * next++ : null));
    this.lines.frustumCulled = false;
  }

  /** Draws three ellipses on each, in its camera's colour; nothing where they are exaggerated by 0. */
  show(look: Look): void {
    const positions: number[] = [];
    const colours: number[] = [];
    const scale = look.exaggerated * Math.sqrt(CHI_SQUARE_90);
    this.cameras.forEach((camera, index) => {
      const covariance = camera.uncertainty?.covariance;
      if (!covariance || scale === 0) return;
      const centre = minus(centreOf(camera.returned), this.origin);
      const [a, b, c] = rootOf(covariance);
      const colour = srgb(...(look.colours[index] ?? look.beforeColour));
      for (const [one, other] of [[a, b], [b, c], [c, a]] as const) {
        for (let corner = 0; corner < 2 * CORNERS; corner++) {
          const angle = (2 * Math.PI * ((corner + 1) >> 1)) / CORNERS; // each segment begins where the last one ended
          const [x, y] = [scale * Math.cos(angle), scale * Math.sin(angle)];
          positions.push(...centre.map((value, axis) => value + x * (one[axis] ?? 0) + y * (other[axis] ?? 0)));
          colours.push(...colour);
        }
      }
    });
    this.lines.geometry.dispose();
    this.lines.geometry = linesOf(positions, colours);
  }

  /** The first point on each of a camera's ellipses as drawn, relative to the origin; nothing without them. */
  drawn(index: number): Triple[] {
    const first = this.first[index] ?? null;
    const positions = this.lines.geometry.getAttribute("position");
    if (first === null || !positions || positions.count === 0) return [];
    return [0, 1, 2].map((circle) => {
      const at = first + 2 * CORNERS * circle;
      return [positions.getX(at), positions.getY(at), positions.getZ(at)];
    });
  }

  dispose(): void {
    this.lines.geometry.dispose();
    (this.lines.material as LineBasicMaterial).dispose();
  }
}
