// The document's title: what one tab among many is known by.
import { useEffect } from "preact/hooks";

export function useTitle(text: string): void {
  useEffect(() => {
    document.title = text ? `${text} – BiResNeRF` : "BiResNeRF";
  }, [text]);
}
