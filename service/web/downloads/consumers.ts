// The programs that read the files of a result, and how to get them.
import type { ArtifactView } from "schemas";
import formats from "../formats.json"; // written by `make docs` from biresnerf/data/formats

export interface Consumer {
  name: string;
  words: string;
  /** A file, or a folder (ending in a slash). */
  files: string;
  /** The format to request if it is not written by default. */
  exported?: string;
}

export const CONSUMERS: readonly Consumer[] = [
  ...formats.results,
  { name: "To share", words: "The views of this page in one file that needs no network", files: "report.html" },
  { name: "To share, as a video", words: "A flight around the scene", files: "renders/orbit.mp4" },
  { name: "Numbers and evidence", words: "The figures behind the verdict, and the outcome for each image", files: "report.json" },
  {
    name: "The refined poses, which the verdict rejected",
    words: "In the same formats as the result",
    files: "refined/",
  },
];

export function filesFor(consumer: Consumer, artifacts: readonly ArtifactView[]): ArtifactView[] {
  const { files } = consumer;
  return artifacts.filter(({ name }) => (files.endsWith("/") ? name.startsWith(files) : name === files));
}

/** Shell lines that download the same files. */
export function curlLines(jobUrl: string, consumer: Consumer, found: readonly ArtifactView[], keyed: boolean): string {
  const key = keyed ? ' -H "Authorization: Bearer $BIRESNERF_API_KEY"' : "";
  const single = found.length === 1 ? found[0] : undefined;
  if (single) return `curl -fL${key} -O ${new URL(single.href, jobUrl).href}`;
  const origin = new URL(jobUrl).origin;
  return [
    `curl -f${key} ${jobUrl}/artifacts |`,
    `  jq -r '.items[] | select(.name | startswith("${consumer.files}")) | [.name, .href] | @tsv' |`,
    `  while IFS=$'\\t' read -r name href; do curl -fL${key} --create-dirs -o "$name" "${origin}$href"; done`,
  ].join("\n");
}

/** Python lines that download the same files. */
export function pythonLines(jobUrl: string, id: string, consumer: Consumer, keyed: boolean): string {
  const url = new URL(jobUrl).origin;
  const wanted = consumer.files.endsWith("/") ? `${consumer.files}*` : consumer.files;
  return [
    ...(keyed ? ["import os"] : []),
    "from pathlib import Path",
    "from biresnerf.client import Client",
    "",
    `with Client("${url}"${keyed ? ', api_key=os.environ["BIRESNERF_API_KEY"]' : ""}) as client:`,
    `    client.download_all("${id}", Path("result"), names=["${wanted}"])`,
  ].join("\n");
}
