// A job that did not succeed: what failed, on which images, and what to do next.
import type { JobView } from "schemas";
import { ProblemBox } from "../parts/problem_box";

export function Failure({ job, images }: { job: JobView; images: readonly string[] }) {
  const { error } = job;
  if (job.state === "expired") {
    return (
      <section class="card">
        <h2>Its files were kept for their time, and are gone</h2>
        <p>The images may still be there: run it again.</p>
      </section>
    );
  }
  if (job.partial) return null; // the verdict's sentence says so
  if (job.state === "cancelled") {
    return (
      <section class="card">
        <h2>Ended on request</h2>
        <p>It left its log alone. Run it again, or fork it, to go on.</p>
      </section>
    );
  }
  if (!error) return null;
  // Names of images stand in the text of the error as the input wrote them.
  const named = images.filter((name) => `${error.where} ${error.detail}`.includes(name));
  const shorter = Object.entries(job.smaller);
  return (
    <section class="failure">
      <ProblemBox problem={error} heading={HEADINGS[error.code] ?? "The job failed"} />
      {named.length > 0 && (
        <p>
          Images: {named.map((name) => <code key={name}>{name} </code>)}
        </p>
      )}
      {shorter.length > 0 && (
        <p>
          Its second try used less memory: {shorter.map(([name, value]) => `${name} ${String(value)}`).join(", ")}.
        </p>
      )}
      {!error.hint && <p>{NEXT[error.code] ?? "The log below says what it did last."}</p>}
      {error.log_tail && (
        <details open>
          <summary>The end of its log</summary>
          <pre tabIndex={0} aria-label="The end of its log">
            {error.log_tail}
          </pre>
        </details>
      )}
    </section>
  );
}

const HEADINGS: Record<string, string> = {
  timeout: "It took longer than the service allows",
  out_of_memory: "There was not enough memory",
  too_many_crashes: "It crashed again and again",
  engine_error: "Something is wrong with the service",
  diverged: "The optimisation diverged",
};
const NEXT: Record<string, string> = {
  timeout: "Run it again with fewer steps or smaller images (max_image_size), or ask the operator for more time.",
  out_of_memory: "Run it again with a smaller max_image_size or samples_per_step, or with fewer photos.",
  too_many_crashes: "Run it again once; if it crashes again, send the operator its log.",
  diverged: "Run it again with a smaller pose_rate, or let feature matches find the poses (start: colmap).",
};
