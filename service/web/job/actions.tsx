// What can be done with a job: end it, run it again with other options, delete it, pass it on.
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { asProblem, call, type Problem } from "../api/http";
import { Store, useStore } from "../api/store";
import { isOver } from "../jobs/state";
import { OptionsForm } from "../options/form";
import type { Values } from "../options/schema";
import { CopyButton } from "../parts/copy_button";
import { ProblemBox } from "../parts/problem_box";

/** Options to run a job again with, where another part of the page asks for that. */
export const wishedAgain = new Store<{ job: string; values: Values } | null>(null);

export function Actions({ job }: { job: JobView }) {
  return (
    <div class="actions">
      <CopyButton text={location.href} what="the address of this page" label="Copy link" />
      {!isOver(job) && <Cancel job={job} />}
      {job.kind === "refine" && <Again job={job} />}
      {isOver(job) && <Delete job={job} />}
    </div>
  );
}

/** A button that opens a dialog, and the dialog. */
function Asking(props: {
  button: string;
  title: string;
  tone?: string;
  wide?: boolean;
  /** Opens the dialog too, whenever it changes. */
  wish?: object | null;
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
    if (props.wish) show();
  }, [props.wish]);
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

function useAttempt(): [Problem | null, boolean, (doing: () => Promise<void>) => Promise<void>] {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const attempt = async (doing: () => Promise<void>) => {
    setBusy(true);
    setProblem(null);
    try {
      await doing();
    } catch (error) {
      setProblem(asProblem(error));
    }
    setBusy(false);
  };
  return [problem, busy, attempt];
}

function Cancel({ job }: { job: JobView }) {
  const [problem, busy, attempt] = useAttempt();
  const end = (keep_partial: boolean, close: () => void) =>
    attempt(async () => {
      await call("POST", `v1/jobs/${job.id}/cancel`, { json: { keep_partial } });
      close();
    });
  return (
    <Asking button={job.cancel_requested ? "Ending …" : "Cancel"} title="End this job?">
      {(close) => (
        <>
          <p>It ends within 10 seconds. The best poses until then can be kept as a partial result.</p>
          {problem && <ProblemBox problem={problem} />}
          <p class="dialog-acts">
            <button class="act primary" disabled={busy} onClick={() => end(true, close)}>
              End it, keep the poses so far
            </button>
            <button class="act" disabled={busy} onClick={() => end(false, close)}>
              End it, keep nothing
            </button>
            <button class="act" onClick={close}>
              Let it run
            </button>
          </p>
        </>
      )}
    </Asking>
  );
}

function Delete({ job }: { job: JobView }) {
  const [problem, busy, attempt] = useAttempt();
  const remove = () =>
    attempt(async () => {
      await call("DELETE", `v1/jobs/${job.id}`);
      location.hash = "#/";
    });
  return (
    <Asking button="Delete" title="Delete this job?" tone="danger">
      {(close) => (
        <>
          <p>Its files and exports go for good. The images that it was made from stay.</p>
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
    </Asking>
  );
}

function Again({ job }: { job: JobView }) {
  const [values, setValues] = useState<Values>({});
  const [problem, busy, attempt] = useAttempt();
  const labels = job.labels;
  const wished = useStore(wishedAgain);
  const wish = wished?.job === job.id ? wished : null;
  useEffect(() => {
    if (!wish) return;
    setValues((chosen) => ({ ...chosen, ...wish.values }));
    wishedAgain.set(null);
  }, [wish]);
  const show = (made: JobView, close: () => void) => {
    close();
    location.hash = `#/jobs/${made.id}`;
  };
  const fork = (close: () => void) =>
    attempt(async () => {
      const json = { options: values, labels };
      show(await call<JobView>("POST", `v1/jobs/${job.id}/fork`, { json }), close);
    });
  const anew = (close: () => void) =>
    attempt(async () => {
      // Another preset fills all options anew; otherwise those of this job hold.
      const options = values.preset ? values : { ...job.options, ...values };
      show(await call<JobView>("POST", "v1/jobs", { json: { dataset_id: job.dataset_id, options, labels } }), close);
    });
  return (
    <Asking button="Run again …" title="Run again with other options" wide wish={wish}>
      {(close) => (
        <>
          <OptionsForm values={values} onChange={setValues} base={job.resolved_options ?? job.options} problems={problem?.errors ?? []} />
          <p class="soft">
            A fork takes over COLMAP's answer or the whole of stage 1, whichever the changed options allow; where they allow
            neither, the service says why.
          </p>
          {problem && <ProblemBox problem={problem} />}
          <p class="dialog-acts">
            <button class="act primary" disabled={busy} onClick={() => anew(close)}>
              Run from the start
            </button>
            <button class="act" disabled={busy} onClick={() => fork(close)}>
              Fork: go on from this job's work
            </button>
            <button class="act" onClick={close}>
              Close
            </button>
          </p>
        </>
      )}
    </Asking>
  );
}
