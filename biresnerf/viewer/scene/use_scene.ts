// The three-dimensional picture's life within a page: made, resized, shown anew, taken down.
import { useEffect, useRef, useState } from "preact/hooks";
import type { SceneCamera } from "../result/widget_data";
import { SceneDrawing } from "./drawing";
import type { Look, Viewpoint } from "./geometry";

/**
 * The drawing in `host`, made anew for other cameras and seen from where the last one was; and why there is none.
 * `onLeave` is called when the reader turns away from what a camera saw.
 */
export function useScene(
  host: { readonly current: HTMLDivElement | null },
  cameras: readonly SceneCamera[],
  look: Look,
  onLeave: () => void,
): { drawing: { readonly current: SceneDrawing | null }; failed: string | null } {
  const drawing = useRef<SceneDrawing | null>(null);
  const seenFrom = useRef<Viewpoint | null>(null); // kept while a run's cameras move on
  const [failed, setFailed] = useState<string | null>(null);

  useEffect(() => {
    if (!host.current) return;
    let made: SceneDrawing;
    try {
      made = new SceneDrawing(host.current, cameras, onLeave);
    } catch (error) {
      setFailed(error instanceof Error ? error.message : String(error));
      return;
    }
    drawing.current = made;
    if (seenFrom.current) made.seeFrom(seenFrom.current);
    const observer = new ResizeObserver(([entry]) => {
      if (entry) made.resize(entry.contentRect.width, entry.contentRect.height);
    });
    observer.observe(host.current);
    return () => {
      observer.disconnect();
      seenFrom.current = made.viewpoint();
      made.dispose();
      drawing.current = null;
    };
  }, [cameras]);

  useEffect(() => {
    if (!drawing.current) return;
    drawing.current.show(look);
    tellTruth(host.current, drawing.current, look.selected, look.share);
  }, [cameras, look]);

  return { drawing, failed };
}

/** What is really drawn of the chosen camera, for whoever checks the picture. */
function tellTruth(stage: HTMLElement | null, now: SceneDrawing, selected: number | null, share: number) {
  if (!stage) return;
  stage.dataset.share = String(share);
  stage.dataset.selected = selected === null ? "" : String(selected);
  stage.dataset.centre = selected === null ? "" : now.drawnCentre(selected).join(" ");
  stage.dataset.onScreen = selected === null ? "" : (now.onScreen(selected, 0) ?? []).join(" ");
}
