// What can be done with a job: cancel it, run it again with other options, delete it, copy its link.
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { asProblem, type Problem, requestJson } from "../api/http";
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

/** A button and the dialog that it opens. */
function DialogButton(props: {
  button: string;
  title: string;
  tone?: string;
  wide?: boolean;
  /** Opens the dialog too, whenever it changes. */
  request?: object | null;
  children: (close: () => void) => ComponentChildren;
}) {
  const dialog = useRef<HTMLDialogElement>(null);
  const [open, setOpen] = useState(false);
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
            {props.children(close)}
          </div>
        )}
      </dialog>
    </>
  );
}

function useAttempt(): [Problem | null, boolean, (action: () => Promise<void>) => Promise<void>] {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const attempt = async (action: () => Promise<void>) => {
    setBusy(true);
    setProblem(null);
    try {
      await action();
    } catch (error) {
      setProblem(asProblem(error));
    }
    setBusy(false);
  };
  return [problem, busy, attempt];
}

function Cancel({ job }: { job: JobView }) {
  const [problem, busy, attempt] = useAttempt();
  const cancel = (keep_partial: boolean, close: () => void) =>
    attempt(async () => {
      await requestJson("POST", `v1/jobs/${job.id}/cancel`, { json: { keep_partial } });
      close();
    });
  return (
    <DialogButton button={job.cancel_requested ? "Cancelling …" : "Cancel"} title="Cancel this job?">
      {(close) => (
        <>
          <p>It stops within 10 seconds. The best poses so far can be kept as a partial result.</p>
          {problem && <ProblemBox problem={problem} />}
          <p class="dialog-acts">
            <button class="act primary" disabled={busy} onClick={() => cancel(true, close)}>
              Cancel and keep the poses so far
            </button>
            <button class="act" disabled={busy} onClick={() => cancel(false, close)}>
              Cancel and keep nothing
            </button>
            <button class="act" onClick={close}>
              Let it run
            </button>
          </p>
        </>
      )}
    </DialogButton>
  );
}

function Delete({ job }: { job: JobView }) {
  const [problem, busy, attempt] = useAttempt();
  const remove = () =>
    attempt(async () => {
      await requestJson("DELETE", `v1/jobs/${job.id}`);
      location.hash = "#/";
    });
  return (
    <DialogButton button="Delete" title="Delete this job?" tone="danger">
      {(close) => (
        <>
          <p>Its files and exports are deleted for good. The images that it was made from stay.</p>
          {problem && <ProblemBox problem={problem} />}
          <p class="dialog-acts">
            <button class="act danger" disabled={busy} onClick={remove}>
              Delete it
            </button>
            <button class="act" onClick={close}>
              Keep it
            </button>
          </p>
        </>
      )}
    </DialogButton>
  );
}

function RunAgain({ job }: { job: JobView }) {
  const [values, setValues] = useState<Values>({});
  const [problem, busy, attempt] = useAttempt();
  const labels = job.labels;
  const pending = useStore(runAgainRequest);
  const request = pending?.job === job.id ? pending : null;
  useEffect(() => {
    if (!request) return;
    setValues((chosen) => ({ ...chosen, ...request.values }));
    runAgainRequest.set(null);
  }, [request]);
  const show = (made: JobView, close: () => void) => {
    close();
    location.hash = `#/jobs/${made.id}`;
  };
  const fork = (close: () => void) =>
    attempt(async () => {
      const json = { options: values, labels };
      show(await requestJson<JobView>("POST", `v1/jobs/${job.id}/fork`, { json }), close);
    });
  const restart = (close: () => void) =>
    attempt(async () => {
      // Another preset replaces all options; otherwise this job's options apply.
      const options = values.preset ? values : { ...job.options, ...values };
      show(await requestJson<JobView>("POST", "v1/jobs", { json: { dataset_id: job.dataset_id, options, labels } }), close);
    });
  return (
    <DialogButton button="Run again …" title="Run again with other options" wide request={request}>
      {(close) => (
        <>
          <OptionsForm values={values} onChange={setValues} base={job.resolved_options ?? job.options} problems={problem?.errors ?? []} />
          <p class="soft">
            A fork reuses COLMAP's result or all of stage 1, as far as the changed options allow; if they allow neither, the
            service says why.
          </p>
          {problem && <ProblemBox problem={problem} />}
          <p class="dialog-acts">
            <button class="act primary" disabled={busy} onClick={() => restart(close)}>
              Run from the start
            </button>
            <button class="act" disabled={busy} onClick={() => fork(close)}>
              Fork: continue from this job's work
            </button>
            <button class="act" onClick={close}>
              Close
            </button>
          </p>
        </>
      )}
    </DialogButton>
  );
}
