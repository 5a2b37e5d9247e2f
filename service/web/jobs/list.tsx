// All jobs, newest first, as they are now.
import { useEffect, useState } from "preact/hooks";
import type { JobList, JobView } from "schemas";
import { Pick } from "../../../biresnerf/viewer/widgets/controls";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { asProblem, call, type Problem } from "../api/http";
import { usePicture } from "../api/picture_urls";
import { moment } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { DropZone } from "../upload/drop";
import { Chip, isOver, type JobState, StageBar, STATE_WORDS, titleOf } from "./state";

/** How many more are shown at a time, and how many the service gives at once. */
const PAGE = 24;
const GIVEN_MAX = 200;
/** While something runs, and while nothing does. */
const BUSY_MS = 1500;
const IDLE_MS = 8000;

/** What of the list was looked at, for who comes back to it from a job. */
const looked = { state: "" as JobState | "", wanted: PAGE, scroll: 0 };

export function JobsPage() {
  const [state, setState] = useState(looked.state);
  const [wanted, setWanted] = useState(looked.wanted);
  const { found, problem } = useJobs(state, wanted);
  useTitle("Jobs");
  useEffect(() => {
    Object.assign(looked, { state, wanted });
  }, [state, wanted]);
  useEffect(() => {
    if (found) scrollTo(0, looked.scroll);
    looked.scroll = 0;
  }, [found !== null]);
  const choose = (chosen: JobState | "") => {
    setState(chosen);
    setWanted(PAGE);
  };
  return (
    <>
      <h1 class="unseen">Jobs</h1>
      <DropZone />
      {problem && <ProblemBox problem={problem} />}
      {!found && !problem && <div class="cards" aria-busy="true" />}
      {found && (found.jobs.length > 0 || state) && (
        <section aria-labelledby="jobs-heading">
          <div class="jobs-head">
            <h2 id="jobs-heading">Jobs</h2>
            <Pick label="Show" value={state} onChange={choose} options={CHOICES} />
            <span class="soft" role="status">
              {found.more ? `the newest ${found.jobs.length}` : count(found.jobs.length, "job")}
            </span>
          </div>
          <Cards {...found} onOlder={() => setWanted(found.jobs.length + PAGE)} />
        </section>
      )}
      {found && found.jobs.length === 0 && (
        <p class="soft empty">
          {found.state ? `No job is ${STATE_WORDS[found.state]}.` : "No jobs yet. Drop a set of images above to begin."}
        </p>
      )}
    </>
  );
}

function Cards({ jobs, more, onOlder }: Found & { onOlder: () => void }) {
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
    <a class="card job-card" href={`#/jobs/${job.id}`} onClick={() => (looked.scroll = scrollY)}>
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

interface Found {
  state: JobState | "";
  jobs: JobView[];
  /** Whether there are older ones. */
  more: boolean;
}

/** So many of the newest jobs in a state (all: ""). */
async function newest(state: JobState | "", wanted: number): Promise<Found> {
  const jobs: JobView[] = [];
  let cursor: string | null = null;
  do {
    const limit = String(Math.min(GIVEN_MAX, wanted - jobs.length));
    const asked = new URLSearchParams({ limit, ...(state && { state }), ...(cursor && { cursor }) });
    const page: JobList = await call<JobList>("GET", `v1/jobs?${asked}`);
    jobs.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && jobs.length < wanted);
  return { state, jobs, more: cursor !== null };
}

/** All that are shown are looked at again and again: the one that runs may be older than many that wait. */
function useJobs(state: JobState | "", wanted: number) {
  const [found, setFound] = useState<Found | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    let timer = 0;
    let gone = false;
    const look = async () => {
      let wait = IDLE_MS;
      try {
        if (!document.hidden) {
          const now = await newest(state, wanted);
          if (gone) return;
          setFound(now);
          setProblem(null);
          // A long list is looked at as much less often.
          if (now.jobs.some((job) => !isOver(job))) wait = BUSY_MS * Math.ceil(now.jobs.length / PAGE);
        }
      } catch (error) {
        if (!gone) setProblem(asProblem(error));
      }
      if (!gone) timer = window.setTimeout(look, wait);
    };
    const shown = () => {
      if (document.hidden) return;
      window.clearTimeout(timer);
      void look();
    };
    void look();
    document.addEventListener("visibilitychange", shown);
    return () => {
      gone = true;
      window.clearTimeout(timer);
      document.removeEventListener("visibilitychange", shown);
    };
  }, [state, wanted]);
  return { found, problem };
}
