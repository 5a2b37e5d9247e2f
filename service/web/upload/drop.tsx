// Where image sets are dropped or chosen.
import { useState } from "preact/hooks";
import { useAttempt } from "../api/hooks";
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
  return (
    <section
      class={`drop ${over ? "over" : ""} ${compact ? "compact" : ""}`}
      aria-label="New image set"
      onDragOver={(event) => {
        event.preventDefault();
        setOver(true);
      }}
      onDragLeave={() => setOver(false)}
      onDrop={(event) => {
        event.preventDefault();
        if (event.dataTransfer) void take(fromDrop(event.dataTransfer));
      }}
    >
      <div class="drop-words">
        <p class="drop-lead">Drop a folder of images, a COLMAP model with its images, or an archive</p>
        <p class="soft">
          {formats.read}; zip, tar, tar.gz. Without poses, COLMAP finds them.
        </p>
      </div>
      <div class="drop-buttons">
        <FileButton label="Choose a folder" folder onFiles={(files) => void take(fromInput(files))} />
        <FileButton label="Choose files" onFiles={(files) => void take(fromInput(files))} />
      </div>
      <p class="drop-status" role="status">
        {status}
      </p>
      {problem && <ProblemBox problem={problem} />}
    </section>
  );
}

function FileButton({ label, folder = false, onFiles }: { label: string; folder?: boolean; onFiles: (files: FileList) => void }) {
  const directory = { webkitdirectory: folder }; // not in the types of Preact
  return (
    <label class={folder ? "act primary" : "act"}>
      {label}
      <input
        {...directory}
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
