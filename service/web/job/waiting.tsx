// A job that has nothing to show yet: the photos of its set, the given cameras, and how long it takes.
import type { DatasetView, JobView } from "schemas";
import { count, roughlyBetween } from "../../../biresnerf/viewer/widgets/numbers";
import { Thumb } from "../../../biresnerf/viewer/widgets/thumb";
import { once, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { changesTimes } from "../options/schema";
import { GivenCameras } from "../parts/given_cameras";
import type { SetPhotos } from "../upload/set_photos";

const SHOWN = 48;
const THUMB_PX = 72;

/** The given cameras; without any, when cameras appear. */
export function WaitingCameras({ photos, words }: { photos: SetPhotos | null; words: string }) {
  if (!photos?.list.photos.some(({ world_from_cam }) => world_from_cam)) return <p class="waiting soft">{words}</p>;
  return (
    <>
      <p class="soft">The given cameras. They move once the job works on them.</p>
      <GivenCameras photos={photos} />
    </>
  );
}

export function WaitingPhotos({ job, photos: { list, cellOf } }: { job: JobView; photos: SetPhotos }) {
  const { value: dataset } = useLoaded((signal) => requestJson<DatasetView>("GET", `v1/datasets/${job.dataset_id}`, { signal }), once, [job.dataset_id]);
  const report = dataset?.report;
  const preset = String(job.options.preset ?? report?.preset ?? "");
  const seconds = changesTimes(job.options) ? undefined : report?.expected_s[preset as keyof typeof report.expected_s];
  return (
    <>
      <p class="soft">
        {count(list.photos.length, "photo")}.
        {job.queue_position !== null && " The job starts when a worker is free."}
        {seconds && ` It takes about ${roughlyBetween(...seconds)} after it starts.`}
      </p>
      <ul class="waiting-photos" aria-label="Photos of the set">
        {list.photos.slice(0, SHOWN).map(({ name }, index) => (
          <li key={name} title={name}>
            <Thumb cell={cellOf(index)} size={THUMB_PX} />
          </li>
        ))}
      </ul>
    </>
  );
}
