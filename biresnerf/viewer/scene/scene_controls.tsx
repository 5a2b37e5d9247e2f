// The controls of the three-dimensional view, and the legend of its colours.
import type { PointLayer } from "../result/widget_data";
import { Choice, Pick, Switch } from "../widgets/controls";
import { sourceWords } from "../widgets/words";
import { type ColourBy, css, kindColour, rampColour, scaleOf, signedColour, UNKNOWN } from "./colours";

/** The settings of the controls. */
interface SceneChoice {
  readonly lines: 0 | 1 | 10;
  readonly before: boolean;
  readonly uncertainty: boolean;
  readonly photos: boolean;
  readonly by: ColourBy;
  /** The upper end of each colour scale. */
  readonly caps: Readonly<Partial<Record<ColourBy, number>>>;
  /** Null until set: points may arrive later than the cameras. */
  readonly layer: string | null;
}

export const FIRST_CHOICE: SceneChoice = { lines: 1, before: true, uncertainty: false, photos: true, by: "moved_deg", caps: {}, layer: null };

const colourOption = (value: ColourBy) => {
  const { label, unit } = scaleOf(value, 1);
  return { value, text: unit ? `${label} (${unit})` : label };
};
const MOST_NAMED = 6; // parts that have colours of their own

const LAYERS: Readonly<Record<PointLayer["source"], string>> = {
  given: "the input's points",
  features: "feature matches",
  tracks: "the input's tracks",
  moved: "the input's points, moved",
  field: "surface of the field",
};

/** The points to show: those selected, otherwise the densest. */
export function layerOf(points: readonly PointLayer[], chosen: string | null): PointLayer | null {
  if (chosen !== null) return points.find((layer) => layer.source === chosen) ?? null;
  return points.find((layer) => layer.source === "field") ?? points[0] ?? null;
}

export const capOf = (choice: SceneChoice, by: ColourBy, spread: number): number =>
  choice.caps[by] ?? scaleOf(by, spread).caps[0] ?? 1;

export function SceneControls(props: {
  choice: SceneChoice;
  onChange: (changed: Partial<SceneChoice>) => void;
  points: readonly PointLayer[];
  /** What cameras can be coloured by, and what they are. */
  colours: readonly ColourBy[];
  by: ColourBy;
  spread: number;
  /** How many times too large ellipsoids are; null if there are none. */
  exaggerated: number | null;
  /** Whether there are poses before and after. */
  compared: boolean;
  /** Whether there are photos for the frusta. */
  pictured: boolean;
}) {
  const { choice, onChange, points, by, spread, exaggerated, compared } = props;
  const scale = scaleOf(by, spread);
  const caps = [...scale.caps].sort((a, b) => a - b);
  return (
    <div class="scene-controls">
      {props.colours.length > 1 && (
        <Pick<ColourBy> label="Colour" value={by} onChange={(wanted) => onChange({ by: wanted })} options={props.colours.map(colourOption)} />
      )}
      {caps.length > 0 && (
        <Pick
          label="up to"
          value={capOf(choice, by, spread)}
          onChange={(cap) => onChange({ caps: { ...choice.caps, [by]: cap } })}
          options={caps.map((value) => ({ value, text: `${value} ${scale.unit}` }))}
        />
      )}
      {compared && (
        <Choice
          label="Lines"
          value={choice.lines}
          onChange={(lines) => onChange({ lines })}
          options={[
            { value: 0, text: "off" },
            { value: 1, text: "×1" },
            { value: 10, text: "×10" },
          ]}
        />
      )}
      {points.length > 0 && (
        <Pick
          label="Points"
          value={layerOf(points, choice.layer)?.source ?? ""}
          onChange={(layer) => onChange({ layer })}
          options={[
            { value: "", text: "none" },
            ...points.map((layer) => ({ value: layer.source, text: LAYERS[layer.source] })),
          ]}
        />
      )}
      {props.pictured && <Switch label="Photos" on={choice.photos} onChange={(photos) => onChange({ photos })} />}
      {compared && <Switch label="Input" on={choice.before} onChange={(before) => onChange({ before })} />}
      {exaggerated !== null && (
        <Switch
          label={exaggerated === 1 ? "Uncertainty" : `Uncertainty ×${exaggerated}`}
          on={choice.uncertainty}
          onChange={(uncertainty) => onChange({ uncertainty })}
        />
      )}
    </div>
  );
}

export function Legend(props: { by: ColourBy; cap: number; kinds: readonly string[]; dark: boolean; unknown: boolean }) {
  const { by, cap, kinds, dark } = props;
  const scale = scaleOf(by, 1);
  if (by === "source" || by === "part") {
    if (by === "part" && kinds.length > MOST_NAMED) return <div class="legend">{kinds.length} parts, in colours that repeat</div>;
    return (
      <ul class="legend">
        {kinds.map((kind) => (
          <li key={kind}>
            <i style={{ background: css(kindColour(kind, kinds)) }} /> {by === "part" ? kind : sourceWords(kind)}
          </li>
        ))}
      </ul>
    );
  }
  const stops = Array.from({ length: 17 }, (_, i) => i / 16);
  const colours = stops.map((at) => css(scale.signed ? signedColour(2 * at - 1, dark) : rampColour(at, dark)));
  return (
    <div class="legend">
      <span class="legend-title">
        {scale.label} ({scale.unit})
      </span>
      <span class="legend-ramp" style={{ background: `linear-gradient(to right, ${colours.join(", ")})` }} />
      <span class="legend-ends">
        <span>{scale.signed ? `≤ −${cap}` : "0"}</span>
        <span>≥ {cap}</span>
      </span>
      {props.unknown && (
        <span class="legend-note">
          <i style={{ background: css(UNKNOWN) }} /> {by === "parts_apart_deg" ? "in one part" : "not measured"}
        </span>
      )}
    </div>
  );
}
