// Creates, resizes, updates and disposes of the three-dimensional view within a page.
import { useEffect, useRef, useState } from "preact/hooks";
import type { SceneCamera } from "../result/widget_data";
import { SceneDrawing } from "./drawing";
import type { Look, Viewpoint } from "./geometry";

/**
 * The view in `host`, or why it failed. Other cameras make a new view with the same viewpoint.
 * `onLeave` is called when the user leaves the view through a camera.
 */
export function useScene(
  host: { readonly current: HTMLDivElement | null },
  cameras: readonly SceneCamera[],
  look: Look,
  onLeave: () => void,
): { drawing: { readonly current: SceneDrawing | null }; failed: string | null } {
  const drawing = useRef<SceneDrawing | null>(null);
  const viewpoint = useRef<Viewpoint | null>(null); // kept while the cameras of a run move
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
    if (viewpoint.current) made.setViewpoint(viewpoint.current);
    const observer = new ResizeObserver(([entry]) => {
      if (entry) made.resize(entry.contentRect.width, entry.contentRect.height);
    });
    observer.observe(host.current);
    return () => {
      observer.disconnect();
      viewpoint.current = made.viewpoint();
      made.dispose();
      drawing.current = null;
    };
  }, [cameras]);

  useEffect(() => {
    if (!drawing.current) return;
    drawing.current.show(look);
    exposeState(host.current, drawing.current, look.selected, look.share);
  }, [cameras, look]);

  return { drawing, failed };
}

/** Exposes what is drawn of the selected camera, for tests. */
function exposeState(stage: HTMLElement | null, now: SceneDrawing, selected: number | null, share: number) {
  if (!stage) return;
  stage.dataset.share = String(share);
  stage.dataset.selected = selected === null ? "" : String(selected);
  stage.dataset.centre = selected === null ? "" : now.drawnCentre(selected).join(" ");
  stage.dataset.uncertainty = selected === null ? "" : now.drawnUncertainty(selected).join(" ");
  stage.dataset.onScreen = selected === null ? "" : (now.onScreen(selected, 0) ?? []).join(" ");
}
