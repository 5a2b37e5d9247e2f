// Image sets that were sent and for which no job was started yet.
import type { DatasetList, DatasetView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useAttempt, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { useServed } from "../api/picture_urls";
import { moment } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useState } from "preact/hooks";

const MOST = 24;
const AGAIN_MS = 8000;
const WORDS: Partial<Record<DatasetView["state"], string>> = {
  open: "upload not complete",
  finalizing: "being checked",
  ready: "ready to start",
};

export function WaitingSets() {
  const [version, setVersion] = useState(0);
  const { value: found } = useLoaded(
    (signal) => requestJson<DatasetList>("GET", `v1/datasets?unused=true&limit=${MOST}`, { signal }),
    () => AGAIN_MS,
    [version],
  );
  if (!found?.items.length) return null;
  return (
    <section aria-labelledby="sets-heading">
      <div class="jobs-head">
        <h2 id="sets-heading">Not started yet</h2>
      </div>
      <ul class="cards">
        {found.items.map((dataset) => (
          <li key={dataset.id} class="set-card card">
            <SetCard dataset={dataset} onDeleted={() => setVersion((n) => n + 1)} />
          </li>
        ))}
      </ul>
    </section>
  );
}

function SetCard({ dataset, onDeleted }: { dataset: DatasetView; onDeleted: () => void }) {
  const { id, name, state, report, files, checked, created_at, expires_at } = dataset;
  const picture = useServed(state === "ready" ? `v1/datasets/${id}/thumbnail.jpg` : null);
  const { attempt, busy, problem } = useAttempt();
  const remove = () =>
    attempt(async () => {
      await requestJson("DELETE", `v1/datasets/${id}`);
      onDeleted();
    });
  return (
    <>
      <span class="thumbnail">{picture && <img src={picture} alt="" width={96} height={72} loading="lazy" />}</span>
      <span class="job-lines">
        <a href={`#/datasets/${id}`}>
          <strong>{name}</strong>
        </a>
        <span>
          {report ? count(report.images, "photo") : count(files, "file")} · {WORDS[state]}
          {checked && ` (${checked.photos_read} of ${count(checked.photos, "photo")} read)`}
        </span>
        <span class="soft job-foot">
          {moment(created_at)}
          {expires_at && ` · kept until ${moment(expires_at)}`}
        </span>
      </span>
      <button type="button" class="act small" disabled={busy} aria-label={`Delete ${name}`} onClick={remove}>
        Delete
      </button>
      {problem && <ProblemBox problem={problem} />}
    </>
  );
}
