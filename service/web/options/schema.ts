// Form fields from the JSON Schema of the options.
import type { OptionsView } from "schemas";
import { optionText } from "../../../biresnerf/viewer/widgets/option_words";

/** The part of JSON Schema that pydantic uses for the options. */
interface Schema {
  readonly type?: string;
  readonly description?: string;
  readonly default?: unknown;
  readonly enum?: readonly (string | number)[];
  readonly anyOf?: readonly Schema[];
  readonly items?: Schema;
  readonly level?: "main" | "usual" | "expert" | "research";
  readonly title?: string;
  readonly properties?: Readonly<Record<string, Schema>>;
  readonly minimum?: number;
  readonly maximum?: number;
  readonly exclusiveMinimum?: number;
  readonly exclusiveMaximum?: number;
}

const RATES = /_rate(_final)?$/;
/** What a help says of the number 0. */
const ZERO = /[;,.] 0: ([^.;]+)/;

export type Values = Record<string, unknown>;

/** Whether these options make a job longer or shorter than its preset does, so that no time of it is known. */
export const changesTimes = (values: Values): boolean =>
  ["steps", "time_budget_s", "max_image_size", "samples_per_step"].some((name) => values[name] != null);

export interface Field {
  name: string;
  title: string;
  help: string;
  /** "words": several, with commas between them; "text" may have commas. */
  kind: "choice" | "yes-no" | "number" | "several" | "words" | "text";
  choices: string[];
  whole: boolean;
  least: number | null;
  most: number | null;
}

/** The fields by level; of those for research, the learning rates. */
export function fieldsOf(schema: Schema): { main: Field[]; usual: Field[]; expert: Field[]; research: Field[] } {
  const properties = Object.entries(schema.properties ?? {}).filter(([name]) => name !== "preset");
  const fields = (level: string) =>
    properties.filter(([, property]) => property.level === level).map(([name, property]) => fieldOf(name, property));
  const research = fields("research").filter(({ name }) => RATES.test(name));
  return { main: fields("main"), usual: fields("usual"), expert: fields("expert"), research };
}

function fieldOf(name: string, property: Schema): Field {
  // `T | null`: null stands for the value of the preset.
  const type = property.anyOf?.find((one) => one.type !== "null") ?? property;
  const items = type.items?.enum?.map(String);
  const field: Field = {
    ...{ name, title: property.title ?? name, help: property.description ?? "", kind: "words", choices: [] },
    whole: type.type === "integer",
    least: type.minimum ?? type.exclusiveMinimum ?? null,
    most: type.maximum ?? type.exclusiveMaximum ?? null,
  };
  if (type.enum) return { ...field, kind: "choice", choices: type.enum.map(String) };
  if (type.type === "boolean") return { ...field, kind: "yes-no", choices: ["true", "false"] };
  if (type.type === "integer" || type.type === "number") return { ...field, kind: "number" };
  if (type.type === "string") return { ...field, kind: "text" };
  if (type.type === "array" && items) return { ...field, kind: "several", choices: items };
  return field;
}

/** What a field is for and, where its help says "choice: meaning" of several choices, what the present one means. */
export function helpOf({ help, choices }: Field, present: string): string {
  if (ZERO.test(help)) return help.replace(ZERO, "");
  const named = choices.filter((choice) => help.includes(`${choice}: `));
  if (named.length < 2) return help;
  const purpose = help.slice(0, Math.min(...named.map((choice) => help.indexOf(`${choice}: `))));
  const meaning = named.includes(present) ? help.split(`${present}: `)[1]!.split(";")[0]!.replace(/\.$/, "") : "";
  return meaning ? `${purpose}${meaning[0]!.toUpperCase()}${meaning.slice(1)}.` : purpose;
}

/** The value of a field that is left empty. */
export function presetValue(view: OptionsView, preset: string | null, field: Field): string {
  const filled: Values = preset === null ? {} : { ...view.presets[preset as keyof OptionsView["presets"]] };
  return fieldWords(field, filled[field.name] ?? (view.json_schema as Schema).properties?.[field.name]?.default);
}

/** A value in words; a 0 that stands for something else in these words. */
export function fieldWords({ help }: Field, value: unknown): string {
  const meant = value === 0 ? ZERO.exec(help)?.[1] : undefined;
  return meant ?? words(value);
}

export const words = (value: unknown): string => (value === null || value === undefined ? "decided by the run" : optionText(value));

/** The value of the text in a field; undefined if it is empty. */
export function parsed(field: Field, text: string): unknown {
  const trimmed = text.trim();
  if (!trimmed) return undefined;
  if (field.kind === "number") return Number(trimmed);
  if (field.kind === "yes-no") return trimmed === "true";
  if (field.kind === "words") {
    const words = trimmed.split(/[\n,]/).map((word) => word.trim());
    return words.filter(Boolean);
  }
  return trimmed;
}
