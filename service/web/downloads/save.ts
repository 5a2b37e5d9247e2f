// Saves files of the service on the user's machine.
import { request } from "../api/http";
import { percent } from "../parts/format";

/** A file of a zip, and where its content comes from. */
export interface Packed {
  readonly name: string;
  readonly href: string;
}

/** All files as one zip, packed as they arrive: none is held in memory whole. */
export async function saveZip(files: readonly Packed[], name: string, say: (text: string) => void): Promise<void> {
  const { downloadZip } = await import("client-zip");
  let failure: unknown; // a stream passes on no error but its own
  async function* fetched() {
    for (const [index, file] of files.entries()) {
      say(`Fetching ${percent(index / files.length)}`);
      try {
        yield { name: file.name, input: await request("GET", `${file.href}?redirect=false`) };
      } catch (error) {
        failure = error;
        throw error;
      }
    }
  }
  const zip = await downloadZip(fetched()).blob().catch((error) => {
    throw failure ?? error;
  });
  save(zip, name);
}

export function save(content: Blob, name: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(content);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
