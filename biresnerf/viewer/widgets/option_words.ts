// Options as people read them: by their titles, not by their names in files and requests.
import titles from "../option_titles.json"; // written by `make docs` from the declaration of the options

const TITLES: Readonly<Record<string, string>> = titles;
const NAME = /\b([a-z]+(?:_[a-z0-9]+)+)(?:=(\w+(?:,\w+)*))?/g;
const CHOICE = /^[a-z]+(_[a-z0-9]+)+$/;

export const optionTitle = (name: string): string => TITLES[name] ?? name;

/** The value of an option. */
export function optionText(value: unknown): string {
  if (value === null || value === undefined || value === "") return "–";
  if (Array.isArray(value)) return value.length ? value.join(", ") : "none";
  if (typeof value === "boolean") return value ? "yes" : "no";
  return CHOICE.test(String(value)) ? String(value).replaceAll("_", " ") : String(value);
}

/** A message that may name options, with their titles. */
export function worded(text: string): string {
  return text.replace(NAME, (found, name: string, value?: string) => {
    const title = TITLES[name];
    if (title === undefined) return found;
    return value ? `“${title}: ${value.split(",").map(optionText).join(", ")}”` : `“${title}”`;
  });
}
