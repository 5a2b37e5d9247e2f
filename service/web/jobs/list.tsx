// The list of jobs, kept up to date: those that run first.
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { Pick } from "../../../biresnerf/viewer/widgets/controls";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useLoaded } from "../api/hooks";
import { usePicture, useServed } from "../api/picture_urls";
import { moment } from "../parts/format";
import { notifyOfEnds } from "../parts/notify";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { DropZone } from "../upload/drop";
import { type Jobs, lasting, loadJobs, ORDERS, type Order, PAGE, SEARCHED_MAX, type Wish } from "./load_jobs";
import { Outcome } from "./outcome";
import { Selection } from "./selection";
import { Chip, type JobState, ProgressBar, STATE_WORDS, titleOf } from "./state";
import { WaitingSets } from "./waiting_sets";

/** Filter, order, search, length and scroll position, kept for the way back from a job. */
const listView = { wish: { state: "", order: "newest", search: "", wanted: PAGE } as Wish, scroll: 0 };

export function JobsPage() {
  const [wish, setWish] = useState(listView.wish);
  const [version, setVersion] = useState(0);
  // All that are shown: the running one may be older than many that wait.
  const { value: found, problem } = useLoaded((signal) => loadJobs(wish, signal), lasting, [wish, version]);
  useTitle("Jobs");
  const seen = useRef<readonly JobView[]>([]);
  useEffect(() => {
    if (!found) return;
    notifyOfEnds(seen.current, found.jobs);
    seen.current = found.jobs;
  }, [found]);
  useEffect(() => {
    listView.wish = wish;
  }, [wish]);
  useEffect(() => {
    if (found) scrollTo(0, listView.scroll);
    listView.scroll = 0;
  }, [found !== null]);
  const change = (part: Partial<Wish>) => setWish({ ...wish, wanted: PAGE, ...part });
  const asked = wish.state !== "" || wish.search !== "";
  return (
    <>
      <div class="lead">
        <h1>Fix your camera poses before you train a NeRF or a splat</h1>
        <p class="soft">
          Refined poses come back in your own frame, scale and file format, with a report that shows whether they really improved.
        </p>
      </div>
      <DropZone />
      <WaitingSets />
      {problem && <ProblemBox problem={problem} />}
      {!found && !problem && <div class="cards" aria-busy="true" />}
      {found && (found.jobs.length > 0 || asked) && (
        <section aria-labelledby="jobs-heading">
          <div class="jobs-head">
            <h2 id="jobs-heading">Jobs</h2>
            <Pick label="Show" value={wish.state} onChange={(state) => change({ state })} options={CHOICES} />
            <Pick label="Order" value={wish.order} onChange={(order) => change({ order })} options={ORDER_CHOICES} />
            <label class="pick">
              <span>Find</span>
              <input type="search" value={wish.search} placeholder="name" onInput={(event) => change({ search: event.currentTarget.value })} />
            </label>
            <span class="soft" role="status">
              {found.cut ? `of the newest ${SEARCHED_MAX}` : found.more ? `${found.jobs.length} shown` : count(found.jobs.length, "job")}
            </span>
          </div>
          <Cards
            {...found}
            onMore={() => change({ wanted: found.jobs.length + PAGE })}
            onChanged={() => setVersion((n) => n + 1)}
          />
        </section>
      )}
      {found && found.jobs.length === 0 && <p class="soft empty">{emptyWords(found.wish)}</p>}
      {found && found.jobs.length === 0 && !asked && <Outcome />}
    </>
  );
}

function emptyWords({ state, search }: Wish): string {
  if (search) return `No job is called “${search}”.`;
  return state ? `No job is ${STATE_WORDS[state]}.` : "No jobs yet.";
}

function Cards({ jobs, more, onMore, onChanged }: Jobs & { onMore: () => void; onChanged: () => void }) {
  const [ticked, setTicked] = useState<ReadonlySet<string>>(new Set());
  const selected = useMemo(() => jobs.filter(({ id }) => ticked.has(id)), [jobs, ticked]);
  const tick = (id: string, on: boolean) => {
    setTicked((before) => new Set(on ? [...before, id] : [...before].filter((other) => other !== id)));
  };
  return (
    <>
      <label class="tick-all">
        <input
          type="checkbox"
          checked={jobs.length > 0 && selected.length === jobs.length}
          onChange={(event) => setTicked(new Set(event.currentTarget.checked ? jobs.map(({ id }) => id) : []))}
        />
        Select all
      </label>
      <ul class="cards">
        {jobs.map((job) => (
          <li key={job.id} class="job-item">
            <label class="tick-job">
              <input
                type="checkbox"
                aria-label={`Select ${titleOf(job)}`}
                checked={ticked.has(job.id)}
                onChange={(event) => tick(job.id, event.currentTarget.checked)}
              />
            </label>
            <JobCard job={job} />
          </li>
        ))}
      </ul>
      {more && (
        <p class="more">
          <button class="act" onClick={onMore}>
            More jobs
          </button>
        </p>
      )}
      {selected.length > 0 && (
        <Selection
          selected={selected}
          onDone={() => {
            setTicked(new Set());
            onChanged();
          }}
        />
      )}
    </>
  );
}

const CHOICES: readonly { value: JobState | ""; text: string }[] = [
  { value: "", text: "all" },
  ...Object.entries(STATE_WORDS).map(([value, text]) => ({ value: value as JobState, text })),
];
const ORDER_CHOICES = Object.entries(ORDERS).map(([value, text]) => ({ value: value as Order, text }));

function JobCard({ job }: { job: JobView }) {
  const own = usePicture(job.thumbnail && `v1/jobs/${job.id}/artifacts/${job.thumbnail}`, job.stage ?? "");
  const photo = useServed(job.thumbnail || job.state === "expired" ? null : `v1/datasets/${job.dataset_id}/thumbnail.jpg`);
  const picture = own ?? photo;
  const preset = job.options.preset ?? job.resolved_options?.preset;
  return (
    <a class="card job-card" href={`#/jobs/${job.id}`} onClick={() => (listView.scroll = scrollY)}>
      <span class="thumbnail">{picture && <img src={picture} alt="" width={96} height={72} loading="lazy" />}</span>
      <span class="job-lines">
        <span class="job-head">
          <strong>{titleOf(job)}</strong>
          <Chip job={job} />
        </span>
        <ProgressBar job={job} />
        <span class="soft job-foot">
          {moment(job.created_at)}
          {preset ? ` · ${String(preset)}` : ""}
          {job.expires_at && job.state !== "expired" && ` · kept until ${moment(job.expires_at)}`}
        </span>
      </span>
    </a>
  );
}
