// All jobs, newest first, as they are now.
import { useEffect, useRef, useState } from "preact/hooks";
import type { JobList, JobView } from "../service/answers";
import { asProblem, call, type Problem } from "../service/http";
import { usePicture } from "../service/pictures";
import { moment } from "../format";
import { ProblemBox } from "../problem_box";
import { useTitle } from "../title";
import { DropZone } from "../upload/drop";
import { Chip, isOver, StageBar, titleOf } from "./state";

const PAGE = 24;
/** While something runs, and while nothing does. */
const BUSY_MS = 1500;
const IDLE_MS = 8000;

export function JobsPage() {
  const { jobs, next, problem, older } = useJobs();
  useTitle("Jobs");
  return (
    <>
      <h1 class="unseen">Jobs</h1>
      <DropZone />
      {problem && <ProblemBox problem={problem} />}
      {!jobs && !problem && <div class="cards" aria-busy="true" />}
      {jobs && jobs.length === 0 && <p class="soft empty">No jobs yet. Drop a set of images above to begin.</p>}
      {jobs && jobs.length > 0 && (
        <section aria-labelledby="jobs-heading">
          <h2 id="jobs-heading">Jobs</h2>
          <ul class="cards">
            {jobs.map((job) => (
              <li key={job.id}>
                <JobCard job={job} />
              </li>
            ))}
          </ul>
          {next && (
            <p class="more">
              <button class="act" onClick={older}>
                Older jobs
              </button>
            </p>
          )}
        </section>
      )}
    </>
  );
}

function JobCard({ job }: { job: JobView }) {
  const picture = usePicture(job.thumbnail && `v1/jobs/${job.id}/artifacts/${job.thumbnail}`, job.stage ?? "");
  return (
    <a class="card job-card" href={`#/jobs/${job.id}`}>
      <span class="thumbnail">{picture && <img src={picture} alt="" width={96} height={72} loading="lazy" />}</span>
      <span class="job-lines">
        <span class="job-head">
          <strong>{titleOf(job)}</strong>
          <Chip job={job} />
        </span>
        <StageBar job={job} />
        <span class="soft job-foot">
          {moment(job.created_at)} · {String(job.options.preset)}
        </span>
      </span>
    </a>
  );
}

function useJobs() {
  const [jobs, setJobs] = useState<JobView[] | null>(null);
  const [next, setNext] = useState<string | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const paged = useRef(false);
  useEffect(() => {
    let timer = 0;
    let gone = false;
    const look = async () => {
      let wait = IDLE_MS;
      try {
        if (!document.hidden) {
          const page = await call<JobList>("GET", `v1/jobs?limit=${PAGE}`);
          if (gone) return;
          setJobs((seen) => merged(page, seen ?? [], paged.current));
          if (!paged.current) setNext(page.next_cursor);
          setProblem(null);
          if (page.items.some((job) => !isOver(job))) wait = BUSY_MS;
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
  }, []);
  const older = async () => {
    try {
      const page = await call<JobList>("GET", `v1/jobs?limit=${PAGE}&cursor=${encodeURIComponent(next ?? "")}`);
      paged.current = true;
      setJobs((seen) => [...(seen ?? []), ...page.items.filter(refines)]);
      setNext(page.next_cursor);
    } catch (error) {
      setProblem(asProblem(error));
    }
  };
  return { jobs, next, problem, older };
}

// An export belongs to its job, and is seen there.
const refines = (job: JobView) => job.kind === "refine";

/** The newest page over what was seen before; without older pages it is all there is to show. */
function merged(page: JobList, seen: JobView[], paged: boolean): JobView[] {
  const fresh = page.items.filter(refines);
  if (!paged) return fresh;
  const oldest = fresh.at(-1)?.created_at ?? "";
  return [...fresh, ...seen.filter((job) => job.created_at < oldest)];
}
