// What can be done with a job: cancel it, run it again with other options, delete it, copy its link.
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { useAttempt } from "../api/hooks";
import { type Problem, requestJson } from "../api/http";
import { Store, useStore } from "../api/store";
import { isOver } from "../jobs/state";
import { OptionsForm } from "../options/form";
import type { Values } from "../options/schema";
import { CopyButton } from "../parts/copy_button";
import { ProblemBox } from "../parts/problem_box";

/** Set by other parts of the page to open the dialog for another run with these options. */
export const runAgainRequest = new Store<{ job: string; values: Values } | null>(null);

export function Actions({ job }: { job: JobView }) {
  return (
    <div class="actions">
      <CopyButton text={location.href} what="the address of this page" label="Copy link" />
      {!isOver(job) && <Cancel job={job} />}
      {job.kind === "refine" && <RunAgain job={job} />}
      {isOver(job) && <Delete job={job} />}
    </div>
  );
}

interface Choice {
  label: string;
  tone?: string;
  run: () => Promise<void>;
}

/** A button and the dialog that it opens, which closes when what the user chose there is done. */
function DialogButton(props: {
  button: string;
  title: string;
  tone?: string;
  wide?: boolean;
  choices: readonly Choice[];
  /** The last button, which only closes the dialog. */
  dismiss: string;
  /** Opens the dialog too, whenever it changes. */
  request?: object | null;
  children: (problem: Problem | null) => ComponentChildren;
}) {
  const dialog = useRef<HTMLDialogElement>(null);
  const [open, setOpen] = useState(false);
  const { attempt, busy, problem } = useAttempt();
  const close = () => dialog.current?.close();
  const show = () => {
    setOpen(true);
    if (!dialog.current?.open) dialog.current?.showModal();
  };
  useEffect(() => {
    if (props.request) show();
  }, [props.request]);
  return (
    <>
      <button type="button" class={`act small ${props.tone ?? ""}`} onClick={show}>
        {props.button}
      </button>
      <dialog
        ref={dialog}
        class={props.wide ? "wide" : ""}
        aria-label={props.title}
        onClose={() => setOpen(false)}
        onClick={(event) => event.target === dialog.current && close()}
      >
        {open && (
          <div class="dialog-body">
            <h2>{props.title}</h2>
            {props.children(problem)}
            {problem && <ProblemBox problem={problem} />}
            <p class="dialog-acts">
              {props.choices.map(({ label, tone = "", run }) => (
                <button key={label} class={`act ${tone}`} disabled={busy} onClick={async () => (await attempt(run)) && close()}>
                  {label}
                </button>
              ))}
              <button class="act" onClick={close}>
                {props.dismiss}
              </button>
            </p>
          </div>
        )}
      </dialog>
    </>
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
        { label: "Fork: continue from this job's work", run: fork },
      ]}
      dismiss="Close"
    >
      {(problem) => (
        <>
          <OptionsForm values={values} onChange={setValues} base={job.resolved_options ?? job.options} problems={problem?.errors ?? []} />
          <p class="soft">
            A fork reuses COLMAP's result or all of stage 1, as far as the changed options allow; if they allow neither, the
            service says why.
          </p>
        </>
      )}
    </DialogButton>
  );
}
