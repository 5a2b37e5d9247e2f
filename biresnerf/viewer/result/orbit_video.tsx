// The film of a flight around the refined scene: to be played, or wound by hand.
import type { ViewFile } from "schemas";
import type { UrlOf } from "./widget_data";

/** Nothing where there is no film. Until it is played, it shows a render. */
export function OrbitVideo({ view, urlOf }: { view: ViewFile; urlOf: UrlOf }) {
  const film = view.orbit && urlOf(view.orbit);
  if (!film) return null;
  const poster = urlOf(view.views[0]?.pictures.render ?? "");
  return (
    <video
      class="orbit"
      {...{ src: film, ...(poster && { poster }), controls: true, loop: true, muted: true }}
      preload="none"
      playsInline
      aria-label="A flight around the scene"
    />
  );
}
