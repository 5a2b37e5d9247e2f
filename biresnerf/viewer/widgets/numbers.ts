// Numbers for display.

type Maybe = number | null | undefined;

const known = (value: Maybe): value is number => value != null && Number.isFinite(value);

/** Significant digits, without an exponent unless the value is tiny or huge. */
export function short(value: Maybe, digits = 3): string {
  if (!known(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) return value.toExponential(digits - 1);
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.min(decimals, 6));
}

export const fixed = (value: Maybe, decimals: number): string => (known(value) ? value.toFixed(decimals) : "–");

/** With its sign, and a true minus. */
export const signed = (value: Maybe, decimals: number): string =>
  known(value) ? `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(decimals)}` : "–";

/** Null of no values. */
export function median(values: readonly number[]): number | null {
  const sorted = [...values].sort((a, b) => a - b);
  const [below, above] = [sorted[(sorted.length - 1) >> 1], sorted[sorted.length >> 1]];
  return below === undefined || above === undefined ? null : (below + above) / 2;
}

export const count = (value: number, one: string, many = `${one}s`): string =>
  `${value.toLocaleString("en-GB")} ${value === 1 ? one : many}`;

interface Size {
  readonly width: number;
  readonly height: number;
}

export const largest = (sizes: readonly Size[]): Size | undefined => [...sizes].sort((a, b) => b.width * b.height - a.width * a.height)[0];

export const pixels = ({ width, height }: Size): string => `${width} × ${height} px`;

export function duration(seconds: number): string {
  const whole = Math.round(seconds);
  if (whole < 60) return `${whole} s`;
  const minutes = Math.floor(whole / 60);
  return minutes < 60
    ? `${minutes} min ${String(whole % 60).padStart(2, "0")} s`
    : `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

/** A predicted time, no more exact than it is. */
export const roughly = (seconds: number): string => amountAndUnit(seconds).join(" ");

/** A predicted time of which the least and the most is known. */
export function roughlyBetween(least: number, most: number): string {
  const [low, high] = [amountAndUnit(least), amountAndUnit(most)];
  if (low.join(" ") === high.join(" ")) return high.join(" ");
  return low[1] === high[1] ? `${low[0]} to ${high.join(" ")}` : `${low.join(" ")} to ${high.join(" ")}`;
}

function amountAndUnit(seconds: number): [string, string] {
  if (seconds < 55) return [`${Math.max(5, 5 * Math.round(seconds / 5))}`, "s"];
  const minutes = seconds / 60;
  return minutes < 90 ? [minutes.toFixed(0), "min"] : [(minutes / 60).toFixed(1), "h"];
}
