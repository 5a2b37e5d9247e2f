// What the reader's system asks for, and what it changes to while the page is open.
import { useEffect, useState } from "preact/hooks";

function useMedia(query: string): boolean {
  const [matches, set] = useState(() => window.matchMedia(query).matches);
  useEffect(() => {
    const media = window.matchMedia(query);
    const changed = () => set(media.matches);
    media.addEventListener("change", changed);
    return () => media.removeEventListener("change", changed);
  }, [query]);
  return matches;
}

export const useDark = (): boolean => useMedia("(prefers-color-scheme: dark)");
export const useStill = (): boolean => useMedia("(prefers-reduced-motion: reduce)");

/** A colour of theme.css as the browser has it. */
export const themeColour = (name: string): string =>
  getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** `#rrggbb` as numbers. */
export function hexColour(hex: string): [number, number, number] {
  const number = Number.parseInt(hex.slice(1), 16);
  return [(number >> 16) & 255, (number >> 8) & 255, number & 255];
}
