// A job's state in words, as a chip and as a bar of stages.
import type { JobView } from "schemas";
import { VerdictChip } from "../../../biresnerf/viewer/widgets/controls";
import { duration } from "../../../biresnerf/viewer/widgets/numbers";
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
const STAGES = Object.keys(STAGE_WORDS) as Stage[];
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

/** Stage, step and time left in one line. */
function progressWords(job: JobView): string {
  if (job.state === "queued") return job.queue_position ? `Number ${job.queue_position} in the queue` : "Waiting";
  if (job.state !== "running") {
    const took = job.started_at && job.finished_at && Date.parse(job.finished_at) - Date.parse(job.started_at);
    return took ? `${STATE_WORDS[job.state]} after ${duration(took / 1000)}` : STATE_WORDS[job.state];
  }
  const { step, steps_total, eta_s } = job.progress;
  const parts = [job.stage ? STAGE_WORDS[job.stage] : "Starting"];
  if (job.message) parts.push(job.message);
  if (steps_total && (job.stage === "coarse" || job.stage === "fine")) parts.push(`step ${step} of ${steps_total}`);
  if (eta_s !== null) parts.push(`${duration(eta_s)} left`);
  return parts.join(" · ");
}

export function StageBar({ job, named = false }: { job: JobView; named?: boolean }) {
  const now = job.stage ? STAGES.indexOf(job.stage) : -1;
  const done = job.state === "succeeded" ? STAGES.length : now;
  const tone = job.state === "failed" ? "bad" : job.state === "cancelled" ? "idle" : "";
  return (
    <div class={`stages ${tone} ${named ? "named" : ""}`}>
      <div
        class="stage-track"
        role="progressbar"
        aria-label={`Progress of ${titleOf(job)}`}
        aria-valuemin={0}
        aria-valuemax={100}
        aria-valuenow={Math.floor(100 * (job.state === "succeeded" ? 1 : job.progress.fraction))}
        aria-valuetext={progressWords(job)}
      >
        {STAGES.map((stage, place) => (
          <span
            key={stage}
            class={place < done ? "past" : place === now && !isOver(job) ? "present" : place === now ? "ended" : ""}
          >
            {named && <span class="stage-name">{STAGE_WORDS[stage]}</span>}
          </span>
        ))}
      </div>
      <p class="stage-words">
        <span>{progressWords(job)}</span>
        {!isOver(job) && <span class="number">{percent(job.progress.fraction)}</span>}
      </p>
    </div>
  );
}
