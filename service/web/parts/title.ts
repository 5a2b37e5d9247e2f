// The document's title, which names the browser tab.
import { useEffect } from "preact/hooks";

export function useTitle(text: string): void {
  useEffect(() => {
    document.title = text ? `${text} – BiResNeRF` : "BiResNeRF";
  }, [text]);
}
