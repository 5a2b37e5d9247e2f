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

/** For flags that deserve attention: what is wrong, and what to do. */
export const ADVICE: Readonly<Partial<Record<Flag, string>>> = {
  contradicted: "Its feature matches disagree with its pose. Leave it out, or add photos taken near it.",
  uncertainty: "Nothing but the photo itself supports its pose. Check it before you rely on it.",
  moved_far: "It moved much further than the others. Compare its photo with its render.",
  blurred: "It is less sharp than photos taken near it. Leave it out if others show the same.",
  exposure_off: "It is brighter or darker than the others make the scene. Run again with exposure on.",
};
export const ALARMING: ReadonlySet<Flag> = new Set(Object.keys(ADVICE) as Flag[]);

export const VERDICTS = {
  improved: { word: "improved", tone: "good" },
  unchanged: { word: "unchanged", tone: "plain" },
  kept_input: { word: "not improved", tone: "plain" },
  inconclusive: { word: "inconclusive", tone: "unsure" },
  failed_check: { word: "failed check", tone: "bad" },
} as const satisfies Record<Verdict["verdict"], { word: string; tone: string }>;

export const sourceWords = (source: string): string => source.replaceAll("-", " ");
