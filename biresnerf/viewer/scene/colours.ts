// Colours of values on absolute scales: the same value has the same colour in every job.
import type { SceneCamera } from "../result/widget_data";

export type ColourBy = "moved_deg" | "moved_units" | "delta_psnr" | "source" | "part" | "parts_apart_deg";
export type Colour = readonly [number, number, number]; // 0 to 255

/** `#rrggbb` as numbers. */
export function hexColour(hex: string): Colour {
  const number = Number.parseInt(hex.slice(1), 16);
  return [(number >> 16) & 255, (number >> 8) & 255, number & 255];
}

// Viridis, as in difference and depth images: perceptually uniform, also for colour-blind readers.
const VIRIDIS = ["#440154", "#472c7a", "#3b518b", "#2c718e", "#21908d", "#27ad81", "#5cc863", "#aadc32", "#fde725"].map(
  hexColour,
);
// Orange is worse, blue is better: colour-blind readers can tell them apart.
const WORSE = hexColour("#d55e00");
const BETTER = hexColour("#0072b2");
const BETTER_ON_DARK = hexColour("#56b4e9");
export const UNKNOWN = hexColour("#80868c");
// The palette of Okabe and Ito without black and yellow, which vanish on a dark or light background.
const KINDS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9"].map(hexColour);

const blend = (a: Colour, b: Colour, share: number): Colour => [
  Math.round(a[0] + share * (b[0] - a[0])),
  Math.round(a[1] + share * (b[1] - a[1])),
  Math.round(a[2] + share * (b[2] - a[2])),
];

/** Colour of a value from 0 to 1, clamped. The end of the map that would vanish on the background is left out. */
export function rampColour(value: number, dark: boolean): Colour {
  const inside = Math.min(1, Math.max(0, value));
  const position = (dark ? 0.22 + 0.78 * inside : 0.88 * inside) * (VIRIDIS.length - 1);
  const below = Math.min(Math.floor(position), VIRIDIS.length - 2);
  return blend(VIRIDIS[below] ?? UNKNOWN, VIRIDIS[below + 1] ?? UNKNOWN, position - below);
}

/** Colour of -1 (worse) to 1 (better); the middle is grey. */
export function signedColour(value: number, dark: boolean): Colour {
  const inside = Math.min(1, Math.max(-1, value));
  const grey: Colour = dark ? [150, 155, 160] : [150, 154, 158];
  return inside < 0 ? blend(grey, WORSE, -inside) : blend(grey, dark ? BETTER_ON_DARK : BETTER, inside);
}

export function kindColour(kind: string, kinds: readonly string[]): Colour {
  const found = kinds.indexOf(kind);
  return found < 0 ? UNKNOWN : (KINDS[found % KINDS.length] ?? UNKNOWN);
}

export const css = ([r, g, b]: Colour): string => `rgb(${r} ${g} ${b})`;

interface Scale {
  readonly label: string;
  readonly unit: string;
  /** Upper ends to choose from, the default first; none for categories. */
  readonly caps: readonly number[];
  readonly signed: boolean;
}

/** Caps do not depend on the data, except in world units, which have no absolute size. */
export function scaleOf(by: ColourBy, spread: number): Scale {
  return {
    moved_deg: { label: "turned", unit: "°", caps: [10, 1, 3, 30, 90], signed: false },
    moved_units: { label: "moved", unit: "units", caps: unitCaps(spread), signed: false },
    delta_psnr: { label: "PSNR gain", unit: "dB", caps: [3, 1, 10], signed: true },
    source: { label: "source of the pose", unit: "", caps: [], signed: false },
    part: { label: "part", unit: "", caps: [], signed: false },
    parts_apart_deg: { label: "parts disagree", unit: "°", caps: [0.1, 0.01, 1, 10], signed: false },
  }[by];
}

/** What cameras can be coloured by: some need poses before, some a set that was refined in parts. */
export function coloursOf(cameras: readonly SceneCamera[]): readonly [ColourBy, ...ColourBy[]] {
  const compared = cameras.some(({ before }) => before !== null);
  const parted: ColourBy[] = cameras.some(({ part }) => part !== null) ? ["part", "parts_apart_deg"] : [];
  return compared ? ["moved_deg", "moved_units", "delta_psnr", "source", ...parted] : ["source", ...parted];
}

/** The names that have a colour each; none where the colour is of a number. */
export function kindsOf(cameras: readonly SceneCamera[], by: ColourBy): string[] {
  if (by !== "source" && by !== "part") return [];
  return [...new Set(cameras.map((camera) => camera[by]))].filter((kind) => kind !== null).sort();
}

/** Round numbers near a tenth of the cameras' spread, in world units. */
function unitCaps(spread: number): number[] {
  const power = 10 ** Math.floor(Math.log10(Math.max(spread, 1e-12) / 10));
  return [1, 0.1, 10, 100].map((times) => Number((times * power).toPrecision(1)));
}

export function colourOf(camera: SceneCamera, by: ColourBy, cap: number, kinds: readonly string[], dark: boolean): Colour {
  if (by === "source" || by === "part") return kindColour(camera[by] ?? "", kinds);
  const value = camera[by];
  if (value === null || !Number.isFinite(value)) return UNKNOWN;
  return by === "delta_psnr" ? signedColour(value / cap, dark) : rampColour(value / cap, dark);
}
