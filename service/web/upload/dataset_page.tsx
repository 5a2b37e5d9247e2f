// A set of images: on its way, checked, and what to do with it.
import { useCallback, useEffect, useState } from "preact/hooks";
import type { DatasetView, JobView } from "schemas";
import { count, duration } from "../../../biresnerf/viewer/widgets/numbers";
import { asProblem, call, pause, type Problem } from "../api/http";
import { Store, useStore } from "../api/store";
import { nameLabel } from "../jobs/state";
import { OptionsForm } from "../options/form";
import type { Values } from "../options/schema";
import { bytes, percent } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";
import { CheckTable } from "./check_table";
import { DropZone } from "./drop";
import { transfers } from "./send";
import { StillToCome } from "./still_to_come";
import type { Transfer } from "./transfer";

const LOOK_EVERY_MS = 700;
const NOBODY = new Store<Transfer | null>(null);

export function DatasetPage({ id }: { id: string }) {
  const { dataset, problem, look } = useDataset(id);
  const [, redraw] = useState(0);
  const sending = useStore<Transfer | null>((transfers.get(id) as Store<Transfer | null> | undefined) ?? NOBODY);
  useTitle(dataset ? `${dataset.name} · new job` : "New job");
  useEffect(look, [sending?.phase]);
  if (problem) return <ProblemBox problem={problem} />;
  if (!dataset) return <p class="soft">Loading …</p>;
  const interrupted = dataset.state === "open" && (!sending || sending.phase === "stopped");
  return (
    <div class="dataset">
      <header class="page-head">
        <p class="soft">New job</p>
        <h1>{dataset.name}</h1>
      </header>
      {sending && dataset.state === "open" && <Progress sending={sending} />}
      {sending?.problem && <ProblemBox problem={sending.problem} />}
      {interrupted && <StillToCome dataset={dataset} onBegun={() => redraw((n) => n + 1)} />}
      <CheckTable dataset={dataset} />
      {dataset.state === "rejected" && dataset.error && (
        <ProblemBox problem={dataset.error} heading="The set was not accepted" />
      )}
      {dataset.state === "rejected" && <DropZone compact />}
      {dataset.state === "ready" && <Submit dataset={dataset} />}
    </div>
  );
}

function useDataset(id: string) {
  const [dataset, setDataset] = useState<DatasetView | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [asked, setAsked] = useState(0);
  useEffect(() => {
    let gone = false;
    void (async () => {
      while (!gone) {
        try {
          const seen = await call<DatasetView>("GET", `v1/datasets/${id}`);
          if (gone) return;
          setDataset(seen);
          setProblem(null);
          if (seen.state !== "finalizing" && seen.state !== "open") return;
        } catch (error) {
          const told = asProblem(error);
          if (gone) return;
          setProblem(told);
          if (!told.passing) return;
        }
        await pause(LOOK_EVERY_MS);
      }
    })();
    return () => {
      gone = true;
    };
  }, [id, asked]);
  return { dataset, problem, look: useCallback(() => setAsked((n) => n + 1), []) };
}

function Progress({ sending }: { sending: Transfer }) {
  const share = sending.bytes ? Math.min(1, sending.bytesDone / sending.bytes) : 1;
  const seconds = (Date.now() - sending.startedAt) / 1000;
  const rate = seconds > 1 ? sending.bytesDone / seconds : 0;
  const left = rate && sending.phase === "sending" ? (sending.bytes - sending.bytesDone) / rate : null;
  return (
    <section class="card" aria-label="Upload">
      <div class="meter-head">
        <strong>{sending.phase === "stopped" ? "Stopped" : sending.phase === "sending" ? "Sending" : "Sent"}</strong>
        <span>
          {bytes(Math.min(sending.bytesDone, sending.bytes))} of {bytes(sending.bytes)} · {sending.filesDone} of{" "}
          {count(sending.files, "file")}
          {left !== null && ` · ${duration(left)} left`}
        </span>
      </div>
      <progress max={1} value={share} aria-label="Upload">
        {percent(share)}
      </progress>
      <p class="soft" role="status">
        {sending.waiting && `${sending.waiting}; trying again`}
        {!sending.waiting && sending.known > 0 && `${count(sending.known, "file")} the service had already`}
      </p>
    </section>
  );
}

function Submit({ dataset }: { dataset: DatasetView }) {
  const [values, setValues] = useState<Values>({ preset: "balanced" });
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const submit = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    setProblem(null);
    try {
      const json = { dataset_id: dataset.id, options: values, labels: nameLabel(dataset.name) };
      location.hash = `#/jobs/${(await call<JobView>("POST", "v1/jobs", { json })).id}`;
    } catch (error) {
      setProblem(asProblem(error));
      setBusy(false);
    }
  };
  return (
    <form class="card" onSubmit={submit} aria-label="Options">
      <h2>What to do</h2>
      <OptionsForm values={values} onChange={setValues} problems={problem?.errors ?? []} />
      {problem && <ProblemBox problem={problem} />}
      <p class="submit">
        <button class="act primary" disabled={busy}>
          {busy ? "Submitting …" : "Refine the poses"}
        </button>
      </p>
    </form>
  );
}
