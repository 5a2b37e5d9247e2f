// What can be done with several jobs at once: cancel, delete, download.
import { useState } from "preact/hooks";
import type { ArtifactList, JobView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useAttempt } from "../api/hooks";
import { requestJson } from "../api/http";
import { saveZip } from "../downloads/save";
import { DialogButton } from "../parts/dialog_button";
import { ProblemBox } from "../parts/problem_box";
import { isOver, titleOf } from "./state";

interface Props {
  selected: readonly JobView[];
  onDone: () => void;
}

export function Selection({ selected, onDone }: Props) {
  const [status, setStatus] = useState("");
  const { attempt, busy, problem } = useAttempt();
  const going = selected.filter((job) => !isOver(job));
  const over = selected.filter(isOver);
  const results = over.filter(({ state, partial }) => state === "succeeded" || partial);
  const each = async (jobs: readonly JobView[], act: (job: JobView) => Promise<unknown>) => {
    for (const job of jobs) await act(job);
    onDone();
  };
  const download = () =>
    attempt(async () => {
      const files = [];
      for (const [place, job] of results.entries()) {
        const { items } = await requestJson<ArtifactList>("GET", `v1/jobs/${job.id}/artifacts`);
        const folder = `${place + 1}-${titleOf(job).replaceAll(/[/\\:]/g, "_")}`;
        for (const { preview, name, href } of items) if (!preview) files.push({ name: `${folder}/${name}`, href });
      }
      await saveZip(files, "results.zip", setStatus);
      setStatus("");
    });
  return (
    <div class="selection" role="region" aria-label="Selected jobs">
      <strong>{count(selected.length, "job")} selected</strong>
      {results.length > 0 && (
        <button type="button" class="act small" disabled={busy} onClick={download}>
          {status || `Download ${count(results.length, "result")}`}
        </button>
      )}
      {going.length > 0 && (
        <DialogButton
          button={`Cancel ${going.length}`}
          title={`Cancel ${count(going.length, "job")}?`}
          choices={[
            {
              label: "Cancel and keep nothing",
              tone: "danger",
              run: () => each(going, (job) => requestJson("POST", `v1/jobs/${job.id}/cancel`, { json: { keep_partial: false } })),
            },
            {
              label: "Cancel and keep poses so far",
              run: () => each(going, (job) => requestJson("POST", `v1/jobs/${job.id}/cancel`, { json: { keep_partial: true } })),
            },
          ]}
          dismiss="Let them go on"
        >
          {() => <p>Those that run stop within 10 seconds. Those that wait leave the queue.</p>}
        </DialogButton>
      )}
      {over.length > 0 && (
        <DialogButton
          button={`Delete ${over.length}`}
          title={`Delete ${count(over.length, "job")}?`}
          tone="danger"
          choices={[{ label: "Delete them", tone: "danger", run: () => each(over, (job) => requestJson("DELETE", `v1/jobs/${job.id}`)) }]}
          dismiss="Keep them"
        >
          {() => <p>Their files and exports are deleted for good. The images that they were made from stay.</p>}
        </DialogButton>
      )}
      {selected.length === 2 && (
        <a class="act small" href={`#/compare/${selected.map(({ id }) => id).join("/")}`}>
          Compare
        </a>
      )}
      <button type="button" class="plain-link" onClick={onDone}>
        Clear selection
      </button>
      {problem && <ProblemBox problem={problem} />}
    </div>
  );
}
