// What feature matches say of the photos while COLMAP works, before there is anything to render.
import type { SeedingPreview } from "schemas";
import type { UrlOf } from "../../../biresnerf/viewer/result/widget_data";
import { count } from "../../../biresnerf/viewer/widgets/numbers";

const PHOTOS = "preview/photos.jpg";
const NAMED_MOST = 12;
const HIGH = 48;

export function Seeding({ seeding, urlOf }: { seeding: SeedingPreview; urlOf: UrlOf }) {
  const { images, matched_pairs } = seeding;
  const looked = images.filter(({ features }) => features !== null);
  const lone = looked.filter(({ partners }) => partners === 0);
  const photos = urlOf(PHOTOS);
  return (
    <div class="seeding">
      {photos && <img class="seeding-photos" src={photos} alt="Photos of the set, side by side" />}
      <p>
        Features of {looked.length} of {count(images.length, "photo")} found; {count(matched_pairs, "pair")} of photos match.
      </p>
      {matched_pairs > 0 && <Overlap images={images} />}
      {matched_pairs > 0 && lone.length > 0 && (
        <p class="soft">
          {count(lone.length, "photo")} {lone.length === 1 ? "matches" : "match"} no other so far:{" "}
          {lone.slice(0, NAMED_MOST).map(({ name }) => (
            <>
              <code key={name}>{name}</code>{" "}
            </>
          ))}
          {lone.length > NAMED_MOST && `and ${lone.length - NAMED_MOST} more`}
        </p>
      )}
    </div>
  );
}

/** A bar an image, in the set's order: gaps are where nothing ties the photos to the others. */
function Overlap({ images }: Pick<SeedingPreview, "images">) {
  const most = Math.max(...images.map(({ partners }) => partners));
  const least = Math.min(...images.map(({ partners }) => partners));
  return (
    <figure>
      <svg
        class="overlap"
        viewBox={`0 0 ${images.length} ${HIGH}`}
        preserveAspectRatio="none"
        role="img"
        aria-label={`Each photo matches ${least} to ${most} others.`}
      >
        {images.map(({ name, partners }, place) => (
          <rect key={name} x={place + 0.1} y={HIGH * (1 - partners / most)} width={0.8} height={HIGH * (partners / most)}>
            <title>{`${name}: ${partners}`}</title>
          </rect>
        ))}
      </svg>
      <figcaption class="soft">Photos, in the set's order: how many others each matches, {most} at most</figcaption>
    </figure>
  );
}
