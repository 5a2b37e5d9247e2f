// A job that did not succeed: what failed, for which images, and what to do next.
import type { JobView } from "schemas";
import { optionText, optionTitle } from "../../../biresnerf/viewer/widgets/option_words";
import { ProblemBox } from "../parts/problem_box";

export function Failure({ job, images }: { job: JobView; images: readonly string[] }) {
  const { error } = job;
  if (job.partial && job.state !== "expired") return null; // the verdict says so
  const gone = WITHOUT_RESULT[job.state];
  if (gone && (!error || (job.state === "expired" && job.started_at))) {
    return (
      <section class="card">
        <h2>{gone.title}</h2>
        <p>{gone.words}</p>
      </section>
    );
  }
  if (!error) return null;
  // Errors name images as the input does.
  const named = images.filter((name) => `${error.where} ${error.detail}`.includes(name));
  const reduced = Object.entries(job.smaller);
  return (
    <section class="failure">
      <ProblemBox problem={error} heading={HEADINGS[error.code] ?? "The job failed"} />
      {named.length > 0 && (
        <p>
          Images: {named.map((name) => <code key={name}>{name} </code>)}
        </p>
      )}
      {reduced.length > 0 && (
        <p>
          Its second attempt used less memory: {reduced.map(([name, value]) => `${optionTitle(name)}: ${optionText(value)}`).join(", ")}.
        </p>
      )}
      {!error.hint && <p>{NEXT[error.code] ?? "The log below shows what it did last."}</p>}
      {error.log_tail && (
        <details open>
          <summary>The end of the log</summary>
          <pre tabIndex={0} aria-label="The end of the log">
            {error.log_tail}
          </pre>
        </details>
      )}
    </section>
  );
}

const WITHOUT_RESULT: Record<string, { title: string; words: string }> = {
  expired: { title: "Its files have expired", words: "The images may still be there: run the job again." },
  cancelled: { title: "Cancelled", words: "The run was stopped on request. Its poses were not kept, so there is no result and no verdict: only its log. Run it again, or continue from its work." },
};
export const HEADINGS: Record<string, string> = {
  timeout: "The job took longer than the service allows",
  out_of_memory: "The job ran out of memory",
  too_many_crashes: "The job crashed repeatedly",
  deadline_passed: "The job's deadline passed",
  engine_error: "The service has an internal error",
  diverged: "The optimisation diverged",
};
const NEXT: Record<string, string> = {
  timeout: "Run it again with fewer steps or a smaller working image size, or ask the operator for more time.",
  out_of_memory: "Run it again with a smaller working image size, with fewer samples per step, or with fewer photos.",
  too_many_crashes: "Run it again once; if it crashes again, send the operator its log.",
  diverged: "Run it again with a smaller pose rate at the start, or with starting poses from COLMAP.",
};
