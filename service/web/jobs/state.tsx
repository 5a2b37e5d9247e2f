// A job's state in words, as a chip and as one bar over all of its run.
import type { JobView } from "schemas";
import { VerdictChip } from "../../../biresnerf/viewer/widgets/controls";
import { duration, roughly } from "../../../biresnerf/viewer/widgets/numbers";
import { percent } from "../parts/format";

export type JobState = JobView["state"];
export type Stage = NonNullable<JobView["stage"]>;

export const STAGE_WORDS: Record<Stage, string> = {
  preparing: "Preparing",
  seeding: "Seeding",
  coarse: "Stage 1: poses",
  fine: "Stage 2: detail",
  evaluating: "Evaluating",
  exporting: "Writing",
};
/** What a running job does now. */
const NOW: Record<Stage, string> = {
  preparing: "Reading the photos",
  seeding: "Looking for poses to start from",
  coarse: "Moving the cameras",
  fine: "Refining cameras and detail",
  evaluating: "Testing the refined poses",
  exporting: "Writing the files",
};
export const STATE_WORDS = {
  queued: "waiting",
  running: "running",
  succeeded: "done",
  failed: "failed",
  cancelled: "cancelled",
  expired: "expired",
} as const;

export const isOver = (job: JobView) => !["queued", "running"].includes(job.state);

/** The label that names a job after its image set, within the length allowed for labels. */
export function nameLabel(name: string): { name: string } {
  return { name: [...name].slice(0, 100).join("") };
}

export function titleOf(job: JobView): string {
  return job.labels.name ?? job.id.replace(/^job_/, "Job ").slice(0, 16);
}

export function Chip({ job }: { job: JobView }) {
  if (job.state === "succeeded" && job.verdict) return <VerdictChip verdict={job.verdict} />;
  const tone = job.state === "failed" ? "bad" : job.state === "running" ? "accent" : "plain";
  const cancelling = job.cancel_requested && !isOver(job);
  const words = cancelling ? "cancelling" : STATE_WORDS[job.state];
  return <span class={`chip chip-${tone}`}>{job.partial ? "partial result" : words}</span>;
}

/** Where in its run a job was stopped, as far as it had begun. */
function whereWords({ stage, progress: { step, steps_total } }: JobView): string {
  if (!stage) return "";
  if (stage !== "coarse" && stage !== "fine") return ` while ${NOW[stage].toLowerCase()}`;
  return ` at step ${step} of ${steps_total}`;
}

/** What it does now, the step and the time left, in one line. */
export function progressWords(job: JobView): string {
  if (job.state === "queued") return job.queue_position ? `Number ${job.queue_position} in the queue` : job.message || "Waiting";
  if (job.state !== "running") {
    const took = job.started_at && job.finished_at && Date.parse(job.finished_at) - Date.parse(job.started_at);
    const words = `${STATE_WORDS[job.state]}${job.state === "cancelled" ? whereWords(job) : ""}`;
    return took ? `${words}, after ${duration(took / 1000)}` : words;
  }
  const { step, steps_total } = job.progress;
  const parts = [job.stage ? NOW[job.stage] : "Starting"];
  if (job.message) parts.push(job.message);
  if (steps_total && (job.stage === "coarse" || job.stage === "fine")) parts.push(`step ${step} of ${steps_total}`);
  return parts.join(" · ");
}

/** How much of the whole run is done, verdict and files included, and how long the rest takes; or how long it took. */
export function ProgressBar({ job }: { job: JobView }) {
  const { eta_s, fraction: share } = job.progress;
  const busy = job.metrics.machine_busy ? " (the machine is busy now)" : "";
  const left = eta_s === null ? "" : `${roughly(eta_s)} left${busy}`;
  if (isOver(job)) return <p class="run-words">{progressWords(job)}</p>;
  return (
    <div>
      <div
        class="run-track"
        role="progressbar"
        aria-label={`Progress of ${titleOf(job)}`}
        aria-valuemin={0}
        aria-valuemax={100}
        aria-valuenow={Math.floor(100 * share)}
        aria-valuetext={[progressWords(job), percent(share), left].filter(Boolean).join(", ")}
      >
        <span style={{ width: `${100 * share}%` }} />
      </div>
      <p class="run-words">
        <span>{progressWords(job)}</span>
        <span class="number">
          {percent(share)}
          {left && ` · ${left}`}
        </span>
      </p>
    </div>
  );
}
