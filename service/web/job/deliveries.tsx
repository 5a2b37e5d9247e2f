// Where a job's files are sent once it is over, and what became of each.
import type { DeliveredFile, JobView } from "schemas";
import { useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { isOver } from "../jobs/state";
import { moment } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";

const POLL_MS = 3000;

export function Deliveries({ job }: { job: JobView }) {
  const over = isOver(job);
  // Its events end with the job, before anything is sent.
  const { value: now } = useLoaded(
    (signal) => requestJson<JobView>("GET", `v1/jobs/${job.id}`, { signal }),
    ({ delivered }) => (over && delivered.some(({ state }) => state === "waiting") ? POLL_MS : null),
    [job.id, over],
  );
  return (
    <section class="panel" aria-labelledby="deliveries-heading">
      <h2 id="deliveries-heading">Deliveries</h2>
      {(now ?? job).delivered.map((file) =>
        file.error ? (
          <ProblemBox key={file.name} problem={file.error} heading={`${nameOf(file)} could not be sent to ${file.host}`} />
        ) : (
          <p key={file.name} role="status">
            {nameOf(file)}: {wordsOf(file, over)}
          </p>
        ),
      )}
    </section>
  );
}

function wordsOf({ host, at }: DeliveredFile, over: boolean): string {
  if (at) return `sent to ${host} on ${moment(at)}`;
  return over ? `is being sent to ${host}` : `will be sent to ${host} once the job is over`;
}

const nameOf = ({ name }: DeliveredFile) => name ?? "All files in one zip";
