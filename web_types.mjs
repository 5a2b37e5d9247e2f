// Writes TypeScript types of the service's responses and of a result's files, from docs/openapi.json and
// docs/result.schema.json. `python hatch_build.py --types` runs it before it checks the types.
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";

const read = (file) => JSON.parse(readFileSync(file, "utf8"));
const { schemas: responses } = read("docs/openapi.json").components;
const { $defs: files } = read("docs/result.schema.json");
// A response holds every field, even those that the document calls optional because they have a default.
for (const schema of Object.values(responses)) schema.required = Object.keys(schema.properties ?? {});

function typeOf(schema) {
  if (schema.$ref) return schema.$ref.split("/").at(-1);
  if ("const" in schema) return JSON.stringify(schema.const);
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (schema.anyOf) return schema.anyOf.map(typeOf).join(" | ");
  if (schema.prefixItems) return `readonly [${schema.prefixItems.map(typeOf).join(", ")}]`;
  if (schema.type === "array") return `readonly (${typeOf(schema.items)})[]`;
  if (schema.properties) return `{\n${Object.entries(schema.properties).map(fieldOf(schema)).join("")}}`;
  if (schema.type === "object") return mapOf(schema);
  const types = { string: "string", integer: "number", number: "number", boolean: "boolean", null: "null" };
  return types[schema.type] ?? "unknown";
}

const fieldOf = ({ required = [] }) => ([name, schema]) =>
  `${comment(schema)}readonly ${JSON.stringify(name)}${required.includes(name) ? "" : "?"}: ${typeOf(schema)};\n`;

function mapOf({ additionalProperties: value, propertyNames: names }) {
  const map = `Readonly<Record<${names ? typeOf(names) : "string"}, ${typeof value === "object" ? typeOf(value) : "unknown"}>>`;
  return names?.enum ? `Partial<${map}>` : map;
}

const comment = ({ description }) => (description ? `/** ${description.replaceAll("*/", "* /")} */\n` : "");

const types = Object.entries({ ...responses, ...files }).map(
  ([name, schema]) => `${comment(schema)}export type ${name} = ${typeOf(schema)};\n`,
);
mkdirSync("build", { recursive: true });
writeFileSync("build/schemas.d.ts", types.join("\n"));
