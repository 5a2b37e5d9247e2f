// The photos of a checked set: a click leaves one out or takes it in again, or masks it.
import { useState } from "preact/hooks";
import { Thumb } from "../../../biresnerf/viewer/widgets/thumb";
import { Choice } from "../../../biresnerf/viewer/widgets/controls";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import type { Masks } from "../masks/use_masks";
import { ProblemBox } from "../parts/problem_box";
import type { SetPhotos } from "./set_photos";

const SHOWN_AT_FIRST = 120;
const THUMB_PX = 92;

type Act = "leave out" | "mask";
const ACTS: { value: Act; text: string }[] = [
  { value: "leave out", text: "leaves it out" },
  { value: "mask", text: "masks parts of it" },
];

interface Props {
  photos: SetPhotos;
  leftOut: ReadonlySet<string>;
  masks: Masks;
  onChange: (leftOut: ReadonlySet<string>) => void;
}

export function Photos({ photos: { list, cellOf }, leftOut, masks, onChange }: Props) {
  const [all, setAll] = useState(false);
  const [act, setAct] = useState<Act>("leave out");
  const toggle = (name: string) => {
    const next = new Set(leftOut);
    if (!next.delete(name)) next.add(name);
    onChange(next);
  };
  const maskable = list.photos.some(({ mask }) => mask);
  const shown = all ? list.photos : list.photos.slice(0, SHOWN_AT_FIRST);
  return (
    <section class="card" aria-labelledby="photos-heading">
      <div class="photos-head">
        <h2 id="photos-heading">Photos</h2>
        {maskable && <Choice label="A click" value={act} options={ACTS} onChange={setAct} />}
        <span class="soft" role="status">
          {leftOut.size > 0 && `${leftOut.size} of ${count(list.photos.length, "photo")} left out`}
          {!leftOut.size && !maskable && "Click a photo to leave it out."}
        </span>
        {leftOut.size > 0 && (
          <button type="button" class="act small" onClick={() => onChange(new Set())}>
            Use all
          </button>
        )}
        {masks.painted.size > 0 && (
          <button type="button" class="act small primary" disabled={masks.busy} onClick={() => void masks.save()}>
            {masks.busy ? "Saving …" : `Save ${count(masks.painted.size, "mask")}`}
          </button>
        )}
      </div>
      {list.photos.some(({ mask }) => !mask) && (
        <p class="soft photos-note">Frames of a video cannot be masked here: masks need photos. Send the frames as photos to mask them.</p>
      )}
      <ul class="photos">
        {shown.map(({ name, world_from_cam, masked, mask }, index) => {
          const notes = [!world_from_cam && "no pose", masks.painted.has(index) ? "mask not saved" : masked && "masked"].filter(Boolean);
          return (
          <li key={name}>
            <button
              type="button"
              class={leftOut.has(name) ? "photo left-out" : "photo"}
              aria-pressed={act === "mask" ? undefined : leftOut.has(name)}
              aria-label={[act === "mask" ? `Mask ${name}` : `Leave out ${name}`, ...notes].join(", ")}
              data-notes={notes.join(", ")}
              title={name}
              disabled={act === "mask" && !mask}
              onClick={() => (act === "mask" ? masks.edit(index) : toggle(name))}
            >
              <Thumb cell={cellOf(index)} size={THUMB_PX} />
              <bdi class="photo-name">{name.slice(name.lastIndexOf("/") + 1)}</bdi>
            </button>
          </li>
          );
        })}
      </ul>
      {list.photos.length > shown.length && (
        <button type="button" class="act small" onClick={() => setAll(true)}>
          Show all {list.photos.length}
        </button>
      )}
      {masks.problem && <ProblemBox problem={masks.problem} />}
      {masks.editor}
    </section>
  );
}
