// The files of a result, grouped by the program that reads them.
import { useState } from "preact/hooks";
import type { ArtifactView, JobView, ShareView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useAttempt } from "../api/hooks";
import { address, apiKey, pause, request, requestJson, shared } from "../api/http";
import { artifactUrl } from "../api/picture_urls";
import { useStore } from "../api/store";
import { isOver } from "../jobs/state";
import { CopyButton } from "../parts/copy_button";
import { bytes } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { type Consumer, CONSUMERS, curlLines, filesFor, pythonLines } from "./consumers";
import { save, saveZip } from "./save";

const SHARED_S = 7 * 86_400;

interface Props {
  job: JobView;
  artifacts: readonly ArtifactView[];
  onNewFiles: () => Promise<void>;
}

export function Downloads({ job, artifacts, onNewFiles }: Props) {
  const results = artifacts.filter(({ preview }) => !preview);
  // Further formats are written from poses.json, which a preview does not have.
  const exportable = results.some(({ name }) => name === "poses.json");
  const rows = CONSUMERS.map((consumer) => ({ consumer, files: filesFor(consumer, results) }));
  const guest = useStore(shared);
  const shown = rows.filter(({ consumer, files }) => files.length || (consumer.exported && exportable && !guest));
  return (
    <ul class="downloads">
      {shown.map(({ consumer, files }) => (
        <Row key={consumer.name} job={job} consumer={consumer} files={files} onNewFiles={onNewFiles} />
      ))}
    </ul>
  );
}

interface RowProps extends Omit<Props, "artifacts"> {
  consumer: Consumer;
  files: ArtifactView[];
}

function Row({ job, consumer, files, onNewFiles }: RowProps) {
  const [status, setStatus] = useState("");
  const { attempt, busy, problem } = useAttempt();
  const [open, setOpen] = useState(false);
  const keyed = useStore(apiKey) !== null;
  const jobUrl = address(`v1/jobs/${job.id}`);
  const single = files.length === 1 ? files[0] : undefined;
  const label = (busy && status) || (single ? "Download" : files.length ? "Download .zip" : "Create");
  const act = async () => {
    const done = await attempt(async () => {
      if (single) await saveOne(single);
      else if (files.length) await saveAll(job, consumer, files, setStatus);
      else await exported(job, consumer, setStatus, onNewFiles);
    });
    setStatus("");
    if (!done) setOpen(files.length > 0 && !shared.value); // curl and Python may succeed where the page failed
  };
  const size = files.reduce((sum, file) => sum + file.size, 0);
  return (
    <li class="download">
      <div class="download-words">
        <strong>{consumer.name}</strong>
        <span class="soft">{consumer.words}</span>
      </div>
      <div class="download-act">
        {files.length > 0 && (
          <>
            <span class="soft number">
              {single ? baseName(single) : count(files.length, "file")} · {bytes(size)}
            </span>
            {!shared.value && <button
              type="button"
              class="plain-link"
              aria-expanded={open}
              aria-label={`curl, Python ${consumer.name}`}
              onClick={() => setOpen(!open)}
            >
              curl, Python
            </button>}
          </>
        )}
        {single && !keyed ? (
          <a class="act small" href={artifactUrl(single.href)} download={baseName(single)} aria-label={`Download ${consumer.name}`}>
            Download
          </a>
        ) : (
          <button class="act small" disabled={busy} aria-label={`${label} ${consumer.name}`} onClick={act}>
            {label}
          </button>
        )}
      </div>
      {open && (
        <div class="download-lines">
          <Lines label="curl" text={curlLines(jobUrl, consumer, files, keyed)} />
          <Lines label="Python" text={pythonLines(jobUrl, job.id, consumer, keyed)} />
          {single && <Share job={job} file={single} />}
        </div>
      )}
      {problem && <ProblemBox problem={problem} />}
    </li>
  );
}

const baseName = ({ name }: ArtifactView) => name.slice(name.lastIndexOf("/") + 1);

function Lines({ label, text }: { label: string; text: string }) {
  return (
    <div class="lines">
      <span class="lines-head">
        <span>{label}</span>
        <CopyButton text={text} what={`the ${label} lines`} />
      </span>
      <pre tabIndex={0} aria-label={label}>
        {text}
      </pre>
    </div>
  );
}

function Share({ job, file }: { job: JobView; file: ArtifactView }) {
  const [link, setLink] = useState("");
  const { attempt, problem } = useAttempt();
  const make = async () => {
    const json = { name: file.name, valid_s: SHARED_S };
    setLink(address((await requestJson<ShareView>("POST", `v1/jobs/${job.id}/shares`, { json })).href));
  };
  if (link) return <Lines label="Link that needs no key, valid for 7 days" text={link} />;
  return (
    <>
      <button class="act" onClick={() => attempt(make)}>
        Create a link that needs no key
      </button>
      {problem && <ProblemBox problem={problem} />}
    </>
  );
}

async function exported(job: JobView, consumer: Consumer, say: (text: string) => void, onNewFiles: () => Promise<void>) {
  say("Writing …");
  const json = { formats: [consumer.exported] };
  let made = await requestJson<JobView>("POST", `v1/jobs/${job.id}/exports`, { json });
  while (!isOver(made)) {
    if (made.state === "queued" && made.queue_position) say(`Waiting, number ${made.queue_position}`);
    else say("Writing …");
    await pause(400);
    made = await requestJson<JobView>("GET", `v1/jobs/${made.id}`);
  }
  if (made.error) throw new Error(`${made.error.detail} ${made.error.hint}`);
  await onNewFiles();
}

async function saveOne(file: ArtifactView): Promise<void> {
  const answer = await request("GET", `${file.href}?redirect=false`);
  save(await answer.blob(), baseName(file));
}

/** All files of a consumer as one zip. */
function saveAll(job: JobView, consumer: Consumer, files: readonly ArtifactView[], say: (text: string) => void): Promise<void> {
  const name = `${job.labels.name ?? job.id}-${consumer.files.replaceAll("/", "-")}.zip`.replace("-.zip", ".zip");
  return saveZip(files, name, say);
}
