// The list of jobs, newest first, kept up to date.
import { useEffect, useState } from "preact/hooks";
import type { JobList, JobView } from "schemas";
import { Pick } from "../../../biresnerf/viewer/widgets/controls";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { usePicture } from "../api/picture_urls";
import { moment } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { DropZone } from "../upload/drop";
import { Chip, isOver, type JobState, StageBar, STATE_WORDS, titleOf } from "./state";

/** Jobs per page of the list, and at most per request. */
const PAGE = 24;
const REQUEST_MAX = 200;
/** Between two requests while jobs run, and while none does. */
const BUSY_MS = 1500;
const IDLE_MS = 8000;

/** Filter, length and scroll position, kept for the way back from a job. */
const listView = { state: "" as JobState | "", wanted: PAGE, scroll: 0 };

export function JobsPage() {
  const [state, setState] = useState(listView.state);
  const [wanted, setWanted] = useState(listView.wanted);
  // All that are shown: the running one may be older than many that wait.
  const { value: found, problem } = useLoaded((signal) => newest(state, wanted, signal), lasting, [state, wanted]);
  useTitle("Jobs");
  useEffect(() => {
    Object.assign(listView, { state, wanted });
  }, [state, wanted]);
  useEffect(() => {
    if (found) scrollTo(0, listView.scroll);
    listView.scroll = 0;
  }, [found !== null]);
  const choose = (chosen: JobState | "") => {
    setState(chosen);
    setWanted(PAGE);
  };
  return (
    <>
      <div class="lead">
        <h1>Fix your camera poses before you train a NeRF or a splat</h1>
        <p class="soft">
          Refined poses come back in your own frame, scale and file format, with a report that shows whether they really improved.
        </p>
      </div>
      <DropZone />
      {problem && <ProblemBox problem={problem} />}
      {!found && !problem && <div class="cards" aria-busy="true" />}
      {found && (found.jobs.length > 0 || state) && (
        <section aria-labelledby="jobs-heading">
          <div class="jobs-head">
            <h2 id="jobs-heading">Jobs</h2>
            <Pick label="Show" value={state} onChange={choose} options={CHOICES} />
            <span class="soft" role="status">
              {found.more ? `newest ${found.jobs.length}` : count(found.jobs.length, "job")}
            </span>
          </div>
          <Cards {...found} onOlder={() => setWanted(found.jobs.length + PAGE)} />
        </section>
      )}
      {found && found.jobs.length === 0 && (
        <p class="soft empty">
          {found.state ? `No job is ${STATE_WORDS[found.state]}.` : "No jobs yet. Drop an image set above to start."}
        </p>
      )}
    </>
  );
}

function Cards({ jobs, more, onOlder }: Jobs & { onOlder: () => void }) {
  return (
    <>
      <ul class="cards">
        {jobs.map((job) => (
          <li key={job.id}>
            <JobCard job={job} />
          </li>
        ))}
      </ul>
      {more && (
        <p class="more">
          <button class="act" onClick={onOlder}>
            Older jobs
          </button>
        </p>
      )}
    </>
  );
}

const CHOICES: readonly { value: JobState | ""; text: string }[] = [
  { value: "", text: "all" },
  ...Object.entries(STATE_WORDS).map(([value, text]) => ({ value: value as JobState, text })),
];

function JobCard({ job }: { job: JobView }) {
  const picture = usePicture(job.thumbnail && `v1/jobs/${job.id}/artifacts/${job.thumbnail}`, job.stage ?? "");
  return (
    <a class="card job-card" href={`#/jobs/${job.id}`} onClick={() => (listView.scroll = scrollY)}>
      <span class="thumbnail">{picture && <img src={picture} alt="" width={96} height={72} loading="lazy" />}</span>
      <span class="job-lines">
        <span class="job-head">
          <strong>{titleOf(job)}</strong>
          <Chip job={job} />
        </span>
        <StageBar job={job} />
        <span class="soft job-foot">
          {moment(job.created_at)} · {String(job.options.preset ?? "balanced")}
        </span>
      </span>
    </a>
  );
}

interface Jobs {
  state: JobState | "";
  jobs: JobView[];
  /** Whether there are older jobs. */
  more: boolean;
}

/** The newest jobs in a state; "" stands for all states. */
async function newest(state: JobState | "", wanted: number, signal: AbortSignal): Promise<Jobs> {
  const jobs: JobView[] = [];
  let cursor: string | null = null;
  do {
    const limit = String(Math.min(REQUEST_MAX, wanted - jobs.length));
    const asked = new URLSearchParams({ limit, ...(state && { state }), ...(cursor && { cursor }) });
    const page: JobList = await requestJson<JobList>("GET", `v1/jobs?${asked}`, { signal });
    jobs.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && jobs.length < wanted);
  return { state, jobs, more: cursor !== null };
}

/** How long the list is shown before it is loaded again: the longer it is, the longer. */
function lasting({ jobs }: Jobs): number {
  return jobs.every(isOver) ? IDLE_MS : BUSY_MS * Math.ceil(jobs.length / PAGE);
}
