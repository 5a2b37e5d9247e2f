// URLs that an <img> can load. An <img> sends no API key: where one is needed, the bytes are fetched with it and shown
// from memory.
import { useEffect, useState } from "preact/hooks";
import { address, apiKey, request } from "./http";
import { useStore } from "./store";

/** Most fetched pictures that are kept; the oldest go first. */
const CACHE_MAX = 400;
const cached = new Map<string, string>();
const pending = new Map<string, Promise<string | null>>();

/** The URL of a picture that the service itself serves, once it can be shown. */
export function useServed(path: string | null): string | null {
  const key = useStore(apiKey);
  const [url, setUrl] = useState<string | null>(null);
  useEffect(() => {
    setUrl(null);
    if (!path) return;
    if (!key) return setUrl(address(path));
    let made: string | null = null;
    let gone = false;
    void request("GET", path).then(
      async (response) => {
        if (gone) return;
        made = URL.createObjectURL(await response.blob());
        setUrl(made);
      },
      () => {}, // shown as missing
    );
    return () => {
      gone = true;
      if (made) URL.revokeObjectURL(made);
    };
  }, [path, key]);
  return url;
}

/** The URL of an artifact on the service itself, not in its bucket: the page loads nothing from other hosts. */
export function artifactUrl(href: string, version = ""): string {
  return address(`${href}?redirect=false${version && `&v=${version.slice(0, 12)}`}`);
}

/** The picture's URL, or null while it is fetched; `changed` is called when it has arrived. */
export function pictureUrl(href: string, version: string, changed: () => void): string | null {
  const url = artifactUrl(href, version);
  if (!apiKey.value) return url;
  const found = cached.get(url);
  if (found) return found;
  const coming = pending.get(url) ?? fetched(href, url);
  pending.set(url, coming);
  void coming.then((done) => done && changed());
  return null;
}

async function fetched(href: string, url: string): Promise<string | null> {
  try {
    const response = await request("GET", `${href}?redirect=false`);
    const local = URL.createObjectURL(await response.blob());
    cached.set(url, local);
    for (const [oldest, gone] of cached) {
      if (cached.size <= CACHE_MAX) break;
      cached.delete(oldest);
      URL.revokeObjectURL(gone);
    }
    return local;
  } catch {
    return null; // shown as missing; the next render tries again
  } finally {
    pending.delete(url);
  }
}

/** The URL of one picture, once it can be shown. */
export function usePicture(href: string | null, version: string): string | null {
  const [, rerender] = useState(0);
  const [wanted, setWanted] = useState<string | null>(null);
  useEffect(() => setWanted(href), [href]);
  return wanted ? pictureUrl(wanted, version, () => rerender((n) => n + 1)) : null;
}
