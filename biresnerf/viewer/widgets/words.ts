// Words for the names in a result's files.
import type { ImageReport, Verdict } from "schemas";

export const FLAGS = {
  held_out: "held out",
  fixed: "fixed",
  repaired: "repaired",
  contradicted: "matches disagree",
  moved_far: "moved far",
  blurred: "blurred",
  exposure_off: "exposure off",
  uncertainty: "pose not known",
} as const satisfies Partial<Record<keyof ImageReport, string>>;
export type Flag = keyof typeof FLAGS;

/** Flags that deserve attention. */
export const ALARMING: ReadonlySet<Flag> = new Set(["contradicted", "moved_far", "blurred", "exposure_off", "uncertainty"]);

export const VERDICTS = {
  improved: { word: "improved", tone: "good" },
  unchanged: { word: "unchanged", tone: "plain" },
  kept_input: { word: "input kept", tone: "plain" },
  inconclusive: { word: "inconclusive", tone: "unsure" },
  failed_check: { word: "check failed", tone: "bad" },
} as const satisfies Record<Verdict["verdict"], { word: string; tone: string }>;

export const sourceWords = (source: string): string => source.replaceAll("-", " ");
