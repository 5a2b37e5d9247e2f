// The jobs that a job on a large set has split itself into.
import type { JobList, JobView } from "schemas";
import { once, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { Chip, progressWords, titleOf } from "./state";

export function Parts({ job }: { job: JobView }) {
  // Loaded again with each part that is over; the page of a part is live.
  const { value } = useLoaded((signal) => requestJson<JobList>("GET", `v1/jobs/${job.id}/parts`, { signal }), once, [job.id, job.parts?.over]);
  if (!value) return null;
  return (
    <section class="panel" aria-labelledby="parts-heading">
      <h2 id="parts-heading">Parts</h2>
      <ul class="parts">
        {value.items.map((part) => (
          <li key={part.id}>
            <a href={`#/jobs/${part.id}`}>{titleOf(part)}</a> <Chip job={part} /> <span class="soft">{progressWords(part)}</span>
          </li>
        ))}
      </ul>
    </section>
  );
}
