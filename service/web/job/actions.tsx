// What can be done with a job: cancel it, run it again with other options, delete it, copy its link.
import { useEffect, useState } from "preact/hooks";
import type { CheckReport, DatasetView, JobView } from "schemas";
import { once, useLoaded } from "../api/hooks";
import { type Problem, requestJson, shared } from "../api/http";
import { Store, useStore } from "../api/store";
import { isOver } from "../jobs/state";
import { OptionsForm } from "../options/form";
import { changesTimes, type Values } from "../options/schema";
import { CopyButton } from "../parts/copy_button";
import { DialogButton } from "../parts/dialog_button";
import { Share } from "./share";

/** Set by other parts of the page to open the dialog for another run with these options. */
export const runAgainRequest = new Store<{ job: string; values: Values } | null>(null);

export function Actions({ job }: { job: JobView }) {
  if (useStore(shared)) return null;
  return (
    <div class="actions">
      <CopyButton text={location.href} what="the address of this page" label="Copy address" />
      {(job.state === "succeeded" || (job.state === "cancelled" && job.partial)) && <Share job={job} />}
      {!isOver(job) && <Cancel job={job} />}
      {job.kind === "refine" && <RunAgain job={job} />}
      {isOver(job) && <Delete job={job} />}
    </div>
  );
}

function Cancel({ job }: { job: JobView }) {
  const cancel = (keep_partial: boolean) => () => requestJson<void>("POST", `v1/jobs/${job.id}/cancel`, { json: { keep_partial } });
  return (
    <DialogButton
      button={job.cancel_requested ? "Cancelling …" : "Cancel"}
      title="Cancel this job?"
      choices={[
        { label: "Cancel and keep the poses so far", tone: "primary", run: cancel(true) },
        { label: "Cancel and keep nothing", run: cancel(false) },
      ]}
      dismiss="Let it run"
    >
      {() => <p>It stops within 10 seconds. The best poses so far can be kept as a partial result.</p>}
    </DialogButton>
  );
}

function Delete({ job }: { job: JobView }) {
  const remove = async () => {
    await requestJson("DELETE", `v1/jobs/${job.id}`);
    location.hash = "#/";
  };
  return (
    <DialogButton
      button="Delete"
      title="Delete this job?"
      tone="danger"
      choices={[{ label: "Delete it", tone: "danger", run: remove }]}
      dismiss="Keep it"
    >
      {() => <p>Its files and exports are deleted for good. The images that it was made from stay.</p>}
    </DialogButton>
  );
}

function RunAgain({ job }: { job: JobView }) {
  const [values, setValues] = useState<Values>({});
  const pending = useStore(runAgainRequest);
  const request = pending?.job === job.id ? pending : null;
  useEffect(() => {
    if (!request) return;
    setValues((chosen) => ({ ...chosen, ...request.values }));
    runAgainRequest.set(null);
  }, [request]);
  const submit = async (path: string, json: object) => {
    const made = await requestJson<JobView>("POST", path, { json: { ...json, labels: job.labels } });
    location.hash = `#/jobs/${made.id}`;
  };
  const fork = () => submit(`v1/jobs/${job.id}/fork`, { options: values });
  // Another preset replaces all options; otherwise this job's options apply.
  const options = values.preset ? values : { ...job.options, ...values };
  const restart = () => submit("v1/jobs", { dataset_id: job.dataset_id, options });
  return (
    <DialogButton
      button="Run again …"
      title="Run again with other options"
      wide
      request={request}
      choices={[
        { label: "Run from the start", tone: "primary", run: restart },
        { label: "Continue from this job's work", run: fork },
      ]}
      dismiss="Close"
    >
      {(problem) => <OtherOptions {...{ job, values, problem }} onChange={setValues} />}
    </DialogButton>
  );
}

interface OtherProps {
  job: JobView;
  values: Values;
  onChange: (change: (values: Values) => Values) => void;
  problem: Problem | null;
}

function OtherOptions({ job, values, onChange, problem }: OtherProps) {
  const { value: dataset } = useLoaded((signal) => requestJson<DatasetView>("GET", `v1/datasets/${job.dataset_id}`, { signal }), once, [job.dataset_id]);
  const times = timesOf(job, values, dataset?.report?.expected_s ?? {});
  return (
    <>
      <OptionsForm
        {...{ values, onChange, times }}
        preset={presetOf(job)}
        base={job.resolved_options ?? job.options}
        problems={problem?.errors ?? []}
      />
      <p class="soft">
        {Object.keys(times).length > 0 && "Times are of runs from the start. "}
        Continuing saves time: it reuses COLMAP's result, or the poses of the first stage as well, as far as the changed
        options allow. If they allow neither, you are told why.
      </p>
    </>
  );
}

/** Seconds of a run from the start with each preset. The job's own one may have other steps or sizes than usual. */
function timesOf(job: JobView, values: Values, expected: CheckReport["expected_s"]): CheckReport["expected_s"] {
  if (changesTimes(values)) return {};
  const own = values.preset === undefined && changesTimes(job.options) ? presetOf(job) : null;
  return Object.fromEntries(Object.entries(expected).filter(([preset]) => preset !== own));
}

/** Null where the job names none and no worker has chosen one yet. */
function presetOf(job: JobView): string | null {
  const { preset } = job.resolved_options ?? job.options;
  return typeof preset === "string" ? preset : null;
}
