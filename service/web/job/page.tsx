// One job: its progress, its result and what can be done with it.
import { useEffect, useMemo, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { duration, short } from "../../../biresnerf/viewer/widgets/numbers";
import { optionText, optionTitle } from "../../../biresnerf/viewer/widgets/option_words";
import { VERDICTS } from "../../../biresnerf/viewer/widgets/words";
import { shared } from "../api/http";
import { pictureUrl } from "../api/picture_urls";
import { useStore } from "../api/store";
import { Downloads } from "../downloads/downloads";
import { Parts } from "../jobs/parts";
import { Chip, isOver, ProgressBar, type Stage, STAGE_WORDS, STATE_WORDS, titleOf } from "../jobs/state";
import { moment } from "../parts/format";
import { NotifySwitch } from "../parts/notify";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { Actions } from "./actions";
import { Deliveries } from "./deliveries";
import { Failure } from "./failure";
import { LiveJob, type LiveState } from "./live_job";
import { LogView } from "./log";
import { JobViews } from "./views";

export function JobPage({ id }: { id: string }) {
  const live = useMemo(() => new LiveJob(id), [id]);
  useEffect(() => {
    void live.run();
    return () => live.close();
  }, [live]);
  const seen = useStore(live);
  const guest = useStore(shared);
  const { job, problem } = seen;
  useTitle(job ? `${titleOf(job)} · ${endWords(job)}` : "Job");
  if (!job) return problem ? <ProblemBox problem={problem} /> : <p class="soft">Loading …</p>;
  return (
    <article class="job">
      <Head job={job} seen={seen} />
      {problem && <ProblemBox problem={problem} />}
      <Failure job={job} images={seen.poses?.images.map(({ name }) => name) ?? []} />
      <Announced job={job} />
      {!guest && job.parts && <Parts job={job} />}
      <Views seen={seen} />
      <Files live={live} seen={seen} />
      {job.delivered.length > 0 && <Deliveries job={job} />}
      <Facts job={job} seen={seen} />
      {!guest && <LogView job={job} />}
    </article>
  );
}

const endWords = ({ verdict, state }: JobView): string => (verdict ? VERDICTS[verdict].word : STATE_WORDS[state]);

function Head({ job, seen }: { job: JobView; seen: LiveState }) {
  return (
    <header class="job-header">
      <div class="page-head">
        <h1>
          <bdi>{titleOf(job)}</bdi> {job.state === "succeeded" && job.verdict ? null : <Chip job={job} />}
        </h1>
        <Actions job={job} />
      </div>
      <ProgressBar job={job} />
      {!isOver(job) && job.deadline_at && <p class="soft">It is stopped at {moment(job.deadline_at)}, with the best poses so far.</p>}
      {!isOver(job) && <LiveNumbers job={job} connected={seen.connected} />}
      {!shared.value && job.expires_at && job.state !== "expired" && <p class="soft">Its files are kept until {moment(job.expires_at)}.</p>}
    </header>
  );
}

function LiveNumbers({ job, connected }: { job: JobView; connected: boolean }) {
  const { psnr, moved_deg } = job.metrics;
  const numbers = [
    ["Fit to the photos", psnr === undefined ? "" : `${psnr.toFixed(1)} dB`],
    ["Cameras last turned by", moved_deg === undefined ? "" : `${short(moved_deg, 2)}°`],
    ["Attempt", job.attempt > 1 ? String(job.attempt) : ""],
  ].filter(([, value]) => value);
  return (
    <div class="live">
      {numbers.length > 0 && (
        <dl class="live-numbers">
          {numbers.map(([name, value]) => (
            <div key={name}>
              <dt>{name}</dt>
              <dd>{value}</dd>
            </div>
          ))}
        </dl>
      )}
      <NotifySwitch />
      {!connected && <span class="soft">The connection was lost; reconnecting …</span>}
    </div>
  );
}

/** For screen readers: stages and the end, but not each step. */
function Announced({ job }: { job: JobView }) {
  const text = isOver(job) ? `The job is over: ${endWords(job)}` : job.stage ? `Now: ${job.stage}` : "Waiting";
  return (
    <p class="unseen" role="status">
      {text}
    </p>
  );
}

function Views({ seen }: { seen: LiveState }) {
  const [version, rerender] = useState(0);
  const { artifacts } = seen;
  const urlOf = useMemo(() => {
    const byName = new Map(artifacts.map((artifact) => [artifact.name, artifact]));
    return (file: string) => {
      const found = byName.get(file);
      return found ? pictureUrl(found.href, found.sha256, () => rerender((n) => n + 1)) : null;
    };
  }, [artifacts, version]);
  return <JobViews seen={seen} urlOf={urlOf} />;
}

function Files({ live, seen }: { live: LiveJob; seen: LiveState }) {
  const { job, artifacts } = seen;
  if (!job || !artifacts.some(({ preview, name }) => !preview && name !== "log.txt")) return null;
  return (
    <section class="panel" aria-labelledby="downloads-heading">
      <h2 id="downloads-heading">Downloads</h2>
      <Downloads job={job} artifacts={artifacts} onNewFiles={() => live.refresh()} />
    </section>
  );
}

function Facts({ job, seen }: { job: JobView; seen: LiveState }) {
  const seconds = Object.entries(seen.report?.seconds ?? {});
  const options = Object.entries(job.resolved_options ?? job.options).map(([name, value]) => [optionTitle(name), optionText(value)] as const);
  return (
    <details class="panel">
      <summary>
        <h2>Options and times</h2>
      </summary>
      <dl class="facts">
        <Fact name="Job" value={job.id} />
        {!shared.value && <Fact name="Image set" value={job.dataset_id} link={`#/datasets/${job.dataset_id}`} />}
        {!shared.value && job.forked_from && <Fact name="Forked from" value={job.forked_from} link={`#/jobs/${job.forked_from}`} />}
        {!shared.value && job.parent && <Fact name="Part of" value={job.parent} link={`#/jobs/${job.parent}`} />}
        {!shared.value && job.fixed_from && <Fact name="Joins" value={job.fixed_from} link={`#/jobs/${job.fixed_from}`} />}
        <Fact name="Submitted" value={moment(job.created_at)} />
        {job.expires_at && <Fact name="Kept until" value={moment(job.expires_at)} />}
        {seconds.map(([stage, s]) => (
          <Fact key={stage} name={`Time: ${(STAGE_WORDS[stage as Stage] ?? stage).toLowerCase()}`} value={duration(s)} />
        ))}
        {options.map(([name, value]) => (
          <Fact key={name} name={name} value={value} />
        ))}
      </dl>
    </details>
  );
}

function Fact({ name, value, link }: { name: string; value: string; link?: string }) {
  return (
    <div>
      <dt>{name}</dt>
      <dd>{link ? <a href={link}>{value}</a> : value}</dd>
    </div>
  );
}
