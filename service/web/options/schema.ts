// The options' JSON Schema as fields of a form.
import type { OptionsView } from "schemas";

/** The part of JSON Schema that pydantic uses for the options. */
interface Schema {
  readonly type?: string;
  readonly description?: string;
  readonly default?: unknown;
  readonly enum?: readonly (string | number)[];
  readonly anyOf?: readonly Schema[];
  readonly items?: Schema;
  readonly level?: "usual" | "expert" | "research";
  readonly properties?: Readonly<Record<string, Schema>>;
  readonly minimum?: number;
  readonly maximum?: number;
  readonly exclusiveMinimum?: number;
  readonly exclusiveMaximum?: number;
}

export type Values = Record<string, unknown>;

export interface Field {
  name: string;
  help: string;
  kind: "choice" | "yes-no" | "number" | "several" | "words";
  /** Of a choice, or of several. */
  choices: string[];
  whole: boolean;
  least: number | null;
  most: number | null;
}

/** The usual fields, and those for experts; the ones for research are left out. */
export function fieldsOf(schema: Schema): { usual: Field[]; expert: Field[] } {
  const properties = Object.entries(schema.properties ?? {}).filter(([name]) => name !== "preset");
  const fields = (level: string) =>
    properties.filter(([, said]) => said.level === level).map(([name, said]) => fieldOf(name, said));
  return { usual: fields("usual"), expert: fields("expert") };
}

function fieldOf(name: string, said: Schema): Field {
  // `T | null`: null is "as the preset says".
  const type = said.anyOf?.find((one) => one.type !== "null") ?? said;
  const items = type.items?.enum?.map(String);
  const field: Field = {
    ...{ name, help: said.description ?? "", kind: "words", choices: [] },
    whole: type.type === "integer",
    least: type.minimum ?? type.exclusiveMinimum ?? null,
    most: type.maximum ?? type.exclusiveMaximum ?? null,
  };
  if (type.enum) return { ...field, kind: "choice", choices: type.enum.map(String) };
  if (type.type === "boolean") return { ...field, kind: "yes-no", choices: ["true", "false"] };
  if (type.type === "integer" || type.type === "number") return { ...field, kind: "number" };
  if (type.type === "array" && items) return { ...field, kind: "several", choices: items };
  return field;
}

/** What holds where a field is left empty. */
export function presetValue(view: OptionsView, preset: string, name: string): string {
  const filled: Values = { ...view.presets[preset as keyof OptionsView["presets"]] };
  return words(filled[name] ?? (view.json_schema as Schema).properties?.[name]?.default);
}

export function words(value: unknown): string {
  if (value === null || value === undefined) return "decided by the run";
  if (Array.isArray(value)) return value.length ? value.join(", ") : "none";
  return typeof value === "boolean" ? (value ? "yes" : "no") : String(value);
}

/** What the form's text means; undefined: left to the preset. */
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
