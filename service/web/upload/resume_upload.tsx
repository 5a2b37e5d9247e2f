// How to complete an upload that was interrupted: the page was reloaded, or sending failed.
import type { DatasetView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { DropZone } from "./drop";
import { checkArrived, resume } from "./send";

export function ResumeUpload({ dataset, onStarted }: { dataset: DatasetView; onStarted: () => void }) {
  const { files, missing } = dataset;
  if (files > 0 && missing.length === 0) {
    return (
      <section class="card">
        <h2>{count(files, "file")} arrived, and none is known to be missing</h2>
        <p>The upload has not been marked as complete.</p>
        <p class="submit">
          <button
            class="act primary"
            onClick={() => {
              checkArrived(dataset);
              onStarted();
            }}
          >
            That is all: check them
          </button>
        </p>
      </section>
    );
  }
  return (
    <section class="card">
      <h2>{missing.length ? `${count(missing.length, "file")} still to come` : "Nothing has arrived completely"}</h2>
      <p>
        {missing.length
          ? `${count(files, "file")} arrived. Choose the same folder again: only the missing files are sent.`
          : "Choose the folder or archive again: an archive continues after the last byte that arrived."}
      </p>
      <DropZone
        compact
        onChosen={async (chosen) => {
          await resume(dataset, chosen);
          onStarted();
        }}
      />
    </section>
  );
}
