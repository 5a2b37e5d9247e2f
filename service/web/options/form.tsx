// Preset and options, from the service's description of them.
import { useMemo } from "preact/hooks";
import type { CheckReport, FieldProblem, OptionsView } from "schemas";
import { roughlyBetween } from "../../../biresnerf/viewer/widgets/numbers";
import { worded } from "../../../biresnerf/viewer/widgets/option_words";
import { once, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { ProblemBox } from "../parts/problem_box";
import { type Field, fieldsOf, fieldWords, helpOf, parsed, presetValue, type Values, words } from "./schema";

const PRESET_WORDS: Record<string, string> = {
  fast: "A first result within minutes",
  balanced: "For most image sets",
  quality: "Larger images, more steps",
  paper: "The published configuration",
};

interface PresetProps {
  /** The one that applies; null where a worker has yet to choose it. */
  preset: string | null;
  onChange: (preset: string) => void;
  /** Seconds that a job with each preset would take, as far as known. */
  expected?: CheckReport["expected_s"];
}

interface Props {
  values: Values;
  onChange: (change: (values: Values) => Values) => void;
  /** The preset where the values name none: that of the check, or of the job. */
  preset: string | null;
  /** Values of the fields that are left empty; without it, those of the preset. */
  base?: Values;
  problems?: readonly FieldProblem[];
  /** Shows the presets, too, with the times that are known of jobs with them. */
  times?: CheckReport["expected_s"];
}

let loaded: Promise<OptionsView> | null = null;

/** The description of the options, requested once. */
function loadOptions(): Promise<OptionsView> {
  loaded ??= requestJson<OptionsView>("GET", "v1/options").catch((error) => {
    loaded = null;
    throw error;
  });
  return loaded;
}

/** The presets with their words and times. */
export function Presets({ preset, onChange, expected = {} }: PresetProps) {
  const { value: view, problem } = useLoaded(loadOptions, once, []);
  if (problem) return <ProblemBox problem={problem} />;
  if (!view) return <p class="soft">Loading the presets …</p>;
  return (
    <fieldset class="presets">
      <legend>Preset</legend>
      {Object.keys(view.presets).map((name) => {
        const seconds = expected[name as keyof typeof expected];
        return (
          <label key={name} class={name === preset ? "preset chosen" : "preset"}>
            <input type="radio" name="preset" checked={name === preset} onChange={() => onChange(name)} />
            <strong>{name[0]!.toUpperCase() + name.slice(1)}</strong>
            <span>{PRESET_WORDS[name]}</span>
            {seconds !== undefined && <span class="preset-time">about {roughlyBetween(...seconds)}</span>}
          </label>
        );
      })}
    </fieldset>
  );
}

export function OptionsForm({ values, onChange, preset: usual, base, problems = [], times }: Props) {
  const { value: view, problem } = useLoaded(loadOptions, once, []);
  const fields = useMemo(() => view && fieldsOf(view.json_schema), [view]);
  if (problem) return <ProblemBox problem={problem} />;
  if (!view || !fields) return <p class="soft">Loading the options …</p>;
  const preset = values.preset === undefined ? usual : String(values.preset);
  const fallback = (field: Field) =>
    base && !values.preset && field.name in base ? fieldWords(field, base[field.name]) : presetValue(view, preset, field);
  const set = (name: string, value: unknown) => {
    onChange(({ [name]: _, ...others }) => (value === undefined ? others : { ...others, [name]: value }));
  };
  const row = (field: Field) => (
    <FieldRow
      key={field.name}
      field={field}
      value={values[field.name]}
      fallback={fallback(field)}
      problem={problems.find(({ pointer }) => pointer.split("/").includes(field.name))?.detail}
      onChange={(value) => set(field.name, value)}
    />
  );
  const changed = [...fields.usual, ...fields.expert, ...fields.research].filter(({ name }) => name in values).length;
  return (
    <div class="options">
      {times && <Presets preset={preset} expected={times} onChange={(name) => set("preset", name)} />}
      <div class="fields">{fields.main.map(row)}</div>
      <details>
        <summary>
          More options <span class="soft">{changed ? `${changed} changed` : "decided by the preset"}</span>
        </summary>
        <div class="fields">{fields.usual.map(row)}</div>
        <h3>Schedule, sizes and output</h3>
        <div class="fields">{fields.expert.map(row)}</div>
        <h3>For research</h3>
        <div class="fields">{fields.research.map(row)}</div>
      </details>
    </div>
  );
}

interface RowProps {
  field: Field;
  value: unknown;
  fallback: string;
  problem?: string | undefined;
  onChange: (value: unknown) => void;
}

function FieldRow(props: RowProps) {
  const { field, value, problem } = props;
  const id = `option-${field.name}`;
  const grouped = field.kind === "several";
  const described = `${id}-help${problem ? ` ${id}-problem` : ""}`;
  return (
    <div class={value === undefined ? "field" : "field changed"}>
      {grouped ? <span class="field-name">{field.title}</span> : <label for={id}>{field.title}</label>}
      {grouped ? <Several {...props} /> : <Control {...props} id={id} described={described} />}
      <p class="soft" id={`${id}-help`}>
        {worded(helpOf(field, String(value ?? props.fallback))).replaceAll("`", "")}
      </p>
      {problem && (
        <p class="bad" id={`${id}-problem`} role="alert">
          {worded(problem)}
        </p>
      )}
    </div>
  );
}

function Control({ field, value, fallback, id, described, onChange }: RowProps & { id: string; described: string }) {
  const text = value === undefined ? "" : Array.isArray(value) ? value.join(", ") : String(value);
  if (field.choices.length) {
    return (
      <select
        id={id}
        value={text}
        aria-describedby={described}
        onChange={(event) => onChange(parsed(field, event.currentTarget.value))}
      >
        <option value="">{fallback}</option>
        {field.choices.map((choice) => (
          <option key={choice} value={choice}>
            {field.kind === "yes-no" ? words(choice === "true") : words(choice)}
          </option>
        ))}
      </select>
    );
  }
  const common = {
    ...{ id, value: text, placeholder: fallback, "aria-describedby": described },
    onInput: (event: { currentTarget: HTMLInputElement }) => onChange(parsed(field, event.currentTarget.value)),
  };
  if (field.kind !== "number") return <input type="text" {...common} />;
  return (
    <input
      type="number"
      inputMode={field.whole ? "numeric" : "decimal"}
      step={field.whole ? 1 : "any"}
      min={field.least ?? undefined}
      max={field.most ?? undefined}
      {...common}
    />
  );
}

function Several({ field, value, onChange }: RowProps) {
  const chosen = Array.isArray(value) ? value.map(String) : [];
  const toggle = (choice: string, on: boolean) => {
    const next = on ? [...chosen, choice] : chosen.filter((one) => one !== choice);
    onChange(next.length ? next : undefined);
  };
  return (
    <div class="several" role="group" aria-label={field.title}>
      {field.choices.map((choice) => (
        <label key={choice}>
          <input
            type="checkbox"
            checked={chosen.includes(choice)}
            onChange={(event) => toggle(choice, event.currentTarget.checked)}
          />
          {words(choice)}
        </label>
      ))}
    </div>
  );
}
