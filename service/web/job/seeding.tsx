// Feature matches between the photos while COLMAP runs, before there is anything to render.
import type { SeedingPreview } from "schemas";
import type { UrlOf } from "../../../biresnerf/viewer/result/widget_data";
import { count } from "../../../biresnerf/viewer/widgets/numbers";

const PHOTOS = "preview/photos.jpg";
const NAMES_MAX = 12;
const HEIGHT = 48;

export function Seeding({ seeding, urlOf }: { seeding: SeedingPreview; urlOf: UrlOf }) {
  const { images, matched_pairs } = seeding;
  const searched = images.filter(({ features }) => features !== null);
  const lone = searched.filter(({ partners }) => partners === 0);
  const photos = urlOf(PHOTOS);
  return (
    <div class="seeding">
      {photos && <img class="seeding-photos" src={photos} alt="Photos of the set, side by side" />}
      <p>
        Features of {searched.length} of {count(images.length, "photo")} found
        {matched_pairs > 0 || searched.length === images.length ? `; ${count(matched_pairs, "pair")} of photos match.` : "."}
      </p>
      {matched_pairs > 0 && <Overlap images={images} />}
      {matched_pairs > 0 && lone.length > 0 && (
        <p class="soft">
          {count(lone.length, "photo")} {lone.length === 1 ? "matches" : "match"} no other so far:{" "}
          {lone.slice(0, NAMES_MAX).map(({ name }) => (
            <>
              <code key={name}>{name}</code>{" "}
            </>
          ))}
          {lone.length > NAMES_MAX && `and ${lone.length - NAMES_MAX} more`}
        </p>
      )}
    </div>
  );
}

/** One bar per photo, in the set's order; a gap is a photo without matches. */
function Overlap({ images }: Pick<SeedingPreview, "images">) {
  const most = Math.max(...images.map(({ partners }) => partners));
  const least = Math.min(...images.map(({ partners }) => partners));
  return (
    <figure>
      <svg
        class="overlap"
        viewBox={`0 0 ${images.length} ${HEIGHT}`}
        preserveAspectRatio="none"
        role="img"
        aria-label={`Each photo matches ${least} to ${most} others.`}
      >
        {images.map(({ name, partners }, place) => (
          <rect key={name} x={place + 0.1} y={HEIGHT * (1 - partners / most)} width={0.8} height={HEIGHT * (partners / most)}>
            <title>{`${name}: ${partners}`}</title>
          </rect>
        ))}
      </svg>
      <figcaption class="soft">Photos in the set's order: how many others each one matches (at most {most})</figcaption>
    </figure>
  );
}
