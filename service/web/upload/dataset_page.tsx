// An image set: its upload, its check, and the job to make of it.
import { useState } from "preact/hooks";
import type { DatasetView } from "schemas";
import { count, duration } from "../../../biresnerf/viewer/widgets/numbers";
import { useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { Store, useStore } from "../api/store";
import { bytes, percent } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { CheckTable } from "./check_table";
import { DropZone } from "./drop";
import { Unfinished } from "./fetches";
import { NewJob } from "./new_job";
import { transfers } from "./send";
import type { Transfer } from "./transfer";

const POLL_MS = 700;
const NO_TRANSFER = new Store<Transfer | null>(null);

export function DatasetPage({ id }: { id: string }) {
  const [, rerender] = useState(0);
  const transfer = useStore<Transfer | null>((transfers.get(id) as Store<Transfer | null> | undefined) ?? NO_TRANSFER);
  const { value: dataset, problem } = useDataset(id, transfer?.phase);
  useTitle(dataset ? `${dataset.name} · new job` : "New job");
  if (problem) return <ProblemBox problem={problem} />;
  if (!dataset) return <p class="soft">Loading …</p>;
  const interrupted = dataset.state === "open" && (!transfer || transfer.phase === "stopped");
  return (
    <div class="dataset">
      <header class="page-head">
        <p class="soft">New job</p>
        <h1>{dataset.name}</h1>
      </header>
      {transfer && dataset.state === "open" && <Progress transfer={transfer} />}
      {transfer?.problem && <ProblemBox problem={transfer.problem} />}
      {interrupted && <Unfinished dataset={dataset} onStarted={() => rerender((n) => n + 1)} />}
      {dataset.state === "ready" ? <NewJob key={dataset.id} dataset={dataset} /> : <CheckTable dataset={dataset} />}
      {dataset.state === "rejected" && dataset.error && (
        <ProblemBox problem={dataset.error} heading="The image set was rejected" />
      )}
      {dataset.state === "rejected" && <DropZone compact />}
    </div>
  );
}

function useDataset(id: string, phase: string | undefined) {
  return useLoaded(
    (signal) => requestJson<DatasetView>("GET", `v1/datasets/${id}`, { signal }),
    ({ state }) => (state === "finalizing" || state === "open" ? POLL_MS : null),
    [id, phase],
  );
}

function Progress({ transfer }: { transfer: Transfer }) {
  const share = transfer.bytes ? Math.min(1, transfer.bytesDone / transfer.bytes) : 1;
  const seconds = (Date.now() - transfer.startedAt) / 1000;
  const rate = seconds > 1 ? transfer.bytesDone / seconds : 0;
  const left = rate && transfer.phase === "sending" ? (transfer.bytes - transfer.bytesDone) / rate : null;
  return (
    <section class="card" aria-label="Upload">
      <div class="meter-head">
        <strong>{transfer.phase === "stopped" ? "Stopped" : transfer.phase === "sending" ? "Sending" : "Sent"}</strong>
        <span>
          {bytes(Math.min(transfer.bytesDone, transfer.bytes))} of {bytes(transfer.bytes)} · {transfer.filesDone} of{" "}
          {count(transfer.files, "file")}
          {left !== null && ` · ${duration(left)} left`}
        </span>
      </div>
      <progress max={1} value={share} aria-label="Upload">
        {percent(share)}
      </progress>
      <p class="soft" role="status">
        {transfer.waiting && `${transfer.waiting}; retrying`}
        {!transfer.waiting && transfer.known > 0 && `${count(transfer.known, "file")} already on the service`}
      </p>
    </section>
  );
}
