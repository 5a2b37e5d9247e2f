// A button and the dialog that it opens.
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { useAttempt } from "../api/hooks";
import type { Problem } from "../api/http";
import { ProblemBox } from "./problem_box";

interface Choice {
  label: string;
  tone?: string;
  run: () => Promise<void>;
}

/** The dialog closes when what the user chose there is done. */
export function DialogButton(props: {
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
