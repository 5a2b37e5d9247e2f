// The photos of a checked set: a click leaves one out, or takes it in again.
import { useState } from "preact/hooks";
import { Thumb } from "../../../biresnerf/viewer/widgets/thumb";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import type { SetPhotos } from "./set_photos";

const SHOWN_AT_FIRST = 120;
const THUMB_PX = 92;

interface Props {
  photos: SetPhotos;
  leftOut: ReadonlySet<string>;
  onChange: (leftOut: ReadonlySet<string>) => void;
}

export function Photos({ photos: { list, cellOf }, leftOut, onChange }: Props) {
  const [all, setAll] = useState(false);
  const toggle = (name: string) => {
    const next = new Set(leftOut);
    if (!next.delete(name)) next.add(name);
    onChange(next);
  };
  const shown = all ? list.photos : list.photos.slice(0, SHOWN_AT_FIRST);
  return (
    <section class="card" aria-labelledby="photos-heading">
      <div class="photos-head">
        <h2 id="photos-heading">Photos</h2>
        <span class="soft" role="status">
          {leftOut.size ? `${leftOut.size} of ${count(list.photos.length, "photo")} left out` : "Click a photo to leave it out."}
        </span>
        {leftOut.size > 0 && (
          <button type="button" class="act small" onClick={() => onChange(new Set())}>
            Use all
          </button>
        )}
      </div>
      <ul class="photos">
        {shown.map(({ name, world_from_cam, masked }, index) => (
          <li key={name}>
            <button type="button" class="photo" aria-pressed={leftOut.has(name)} aria-label={`Leave out ${name}`} title={name} onClick={() => toggle(name)}>
              <Thumb cell={cellOf(index)} size={THUMB_PX} />
              <bdi class="photo-name">{name.slice(name.lastIndexOf("/") + 1)}</bdi>
              <span class="soft">{[!world_from_cam && "no pose", masked && "masked"].filter(Boolean).join(", ")}</span>
            </button>
          </li>
        ))}
      </ul>
      {list.photos.length > shown.length && (
        <button type="button" class="act small" onClick={() => setAll(true)}>
          Show all {list.photos.length}
        </button>
      )}
    </section>
  );
}
