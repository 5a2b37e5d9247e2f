// Addresses that an <img> can load. Where the service wants a key, an <img> cannot send it: the bytes are fetched
// then, and shown from memory.
import { useEffect, useState } from "preact/hooks";
import { address, apiKey, ask } from "./http";

/** Fetched pictures by address; a tab holds so many, the oldest go. */
const HELD_MAX = 400;
const held = new Map<string, string>();
const underWay = new Map<string, Promise<string | null>>();

/** Never to the bucket: the page loads nothing from other hosts. */
export function direct(href: string, version = ""): string {
  return address(`${href}?redirect=false${version && `&v=${version.slice(0, 12)}`}`);
}

/** The picture's address now, or null while it is fetched; `changed` is called when it is there. */
export function pictureUrl(href: string, version: string, changed: () => void): string | null {
  const url = direct(href, version);
  if (!apiKey.value) return url;
  const found = held.get(url);
  if (found) return found;
  const coming = underWay.get(url) ?? fetched(href, url);
  underWay.set(url, coming);
  void coming.then((done) => done && changed());
  return null;
}

async function fetched(href: string, url: string): Promise<string | null> {
  try {
    const answer = await ask("GET", `${href}?redirect=false`);
    const local = URL.createObjectURL(await answer.blob());
    held.set(url, local);
    for (const [oldest, gone] of held) {
      if (held.size <= HELD_MAX) break;
      held.delete(oldest);
      URL.revokeObjectURL(gone);
    }
    return local;
  } catch {
    return null; // shown as missing; another draw tries again
  } finally {
    underWay.delete(url);
  }
}

/** The address of one picture, once it can be shown. */
export function usePicture(href: string | null, version: string): string | null {
  const [, redraw] = useState(0);
  const [wanted, setWanted] = useState<string | null>(null);
  useEffect(() => setWanted(href), [href]);
  return wanted ? pictureUrl(wanted, version, () => redraw((n) => n + 1)) : null;
}
