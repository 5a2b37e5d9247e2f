// What to do about a set of which not all arrived: the page was loaded anew, or the sending was given up.
import type { DatasetView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { DropZone } from "./drop";
import { checkArrived, goOn } from "./send";

export function StillToCome({ dataset, onBegun }: { dataset: DatasetView; onBegun: () => void }) {
  const { files, missing } = dataset;
  if (files > 0 && missing.length === 0) {
    return (
      <section class="card">
        <h2>{count(files, "file")} arrived, and none is known to be missing</h2>
        <p>Nobody has said yet that this is all.</p>
        <p class="submit">
          <button
            class="act primary"
            onClick={() => {
              checkArrived(dataset);
              onBegun();
            }}
          >
            That is all: check it
          </button>
        </p>
      </section>
    );
  }
  return (
    <section class="card">
      <h2>{missing.length ? `${count(missing.length, "file")} still to come` : "Nothing has arrived in whole"}</h2>
      <p>
        {missing.length
          ? `${count(files, "file")} arrived. Choose the same folder again: only what is missing is sent.`
          : "Choose the folder or archive again: an archive goes on from its last byte that arrived."}
      </p>
      <DropZone
        compact
        onChosen={async (chosen) => {
          await goOn(dataset, chosen);
          onBegun();
        }}
      />
    </section>
  );
}
