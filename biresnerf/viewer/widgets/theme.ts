// Colour scheme and motion preferences of the reader's system, and colours of the theme.
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
export const useReducedMotion = (): boolean => useMedia("(prefers-reduced-motion: reduce)");

/** The current value of a colour in theme.css. */
export const themeColour = (name: string): string =>
  getComputedStyle(document.documentElement).getPropertyValue(name).trim();
