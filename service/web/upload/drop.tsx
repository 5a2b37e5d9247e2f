// Where image sets are dropped or chosen.
import { useEffect, useRef, useState } from "preact/hooks";
import { useAttempt } from "../api/hooks";
import { request } from "../api/http";
import formats from "../formats.json";
import { percent } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { type Chosen, fromDrop, fromInput, type Gathered } from "./gather";
import { begin } from "./send";

interface Props {
  /** What to do with the files; by default a new dataset is made of them. */
  onChosen?: (chosen: Chosen[]) => Promise<void>;
  compact?: boolean;
}

export function DropZone({ onChosen, compact = false }: Props) {
  const [over, setOver] = useState(false);
  const [status, setStatus] = useState("");
  const { attempt, problem } = useAttempt();
  const take = async (gathered: Gathered | Promise<Gathered>) => {
    setOver(false);
    setStatus("Reading …");
    const done = await attempt(async () => {
      const chosen = await gathered;
      if (!chosen.files.length) setStatus("It holds no files.");
      else if (onChosen) await onChosen(chosen.files);
      else location.hash = `#/datasets/${await begin(chosen, (share) => setStatus(`Reading … ${percent(share)}`))}`;
    });
    if (!done) setStatus("");
  };
  const latest = useRef(take);
  latest.current = take;
  useEffect(() => whileDragged(setOver, (data) => void latest.current(fromDrop(data))), []);
  return (
    <section class={`drop ${over ? "over" : ""} ${compact ? "compact" : ""}`} aria-label="New image set">
      <div class="drop-words">
        <p class="drop-lead mouse-only">Drop photos or a video anywhere on this page</p>
        <p class="drop-lead touch-only">Choose photos or a video</p>
        <p class="soft">
          <span class="mouse-only">A folder or an archive will do.</span> Poses are optional: known formats are read, and missing poses are found.
        </p>
        <details class="drop-formats">
          <summary>Which formats?</summary>
          <p>Poses: {formats.read}.</p>
          <p>Archives: zip, tar, tar.gz.</p>
        </details>
      </div>
      <div class="drop-buttons">
        <FileButton label="Choose a folder" for="mouse" onFiles={(files) => void take(fromInput(files))} />
        <FileButton label="Choose files" onFiles={(files) => void take(fromInput(files))} />
        <FileButton label="Choose photos or a video" for="touch" onFiles={(files) => void take(fromInput(files))} />
        {!compact && !onChosen && (
          <>
            <button type="button" class="act" onClick={() => void take(sample())}>
              Try a sample set
            </button>
            <a class="act" href="#/example">
              See a finished example
            </a>
          </>
        )}
      </div>
      <p class="drop-status" role="status">
        {status}
      </p>
      {problem && <ProblemBox problem={problem} />}
    </section>
  );
}

/** The service's own image set. */
async function sample(): Promise<Gathered> {
  const archive = await (await request("GET", "v1/sample")).blob();
  return { name: "sample", files: [{ path: "sample.zip", file: new File([archive], "sample.zip") }] };
}

/** Listens to files that are dragged over the window; returns how to stop listening. */
function whileDragged(onOver: (over: boolean) => void, onDrop: (data: DataTransfer) => void): () => void {
  const over = (event: DragEvent) => {
    event.preventDefault();
    onOver(true);
  };
  const leave = (event: DragEvent) => event.relatedTarget === null && onOver(false);
  const drop = (event: DragEvent) => {
    event.preventDefault();
    if (event.dataTransfer) onDrop(event.dataTransfer);
  };
  addEventListener("dragover", over);
  addEventListener("dragleave", leave);
  addEventListener("drop", drop);
  return () => {
    removeEventListener("dragover", over);
    removeEventListener("dragleave", leave);
    removeEventListener("drop", drop);
  };
}

interface FileButtonProps {
  label: string;
  /** touch: for phones and tablets, which offer their library and camera; mouse: for a whole folder. */
  for?: "touch" | "mouse";
  onFiles: (files: FileList) => void;
}

function FileButton({ label, for: whom, onFiles }: FileButtonProps) {
  const kind = { webkitdirectory: whom === "mouse", ...(whom === "touch" && { accept: "image/*,video/*" }) }; // not in the types of Preact
  return (
    <label class={whom ? `act primary ${whom}-only` : "act"}>
      {label}
      <input
        {...kind}
        class="unseen"
        type="file"
        multiple
        onChange={(event) => {
          const { files } = event.currentTarget;
          if (files?.length) onFiles(files);
          event.currentTarget.value = "";
        }}
      />
    </label>
  );
}
