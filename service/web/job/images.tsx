// The table of images; the job can be run again without some of them, or with their given poses kept fixed.
import { useState } from "preact/hooks";
import type { JobView } from "schemas";
import type { ImageRow } from "../../../biresnerf/viewer/result/widget_data";
import type { ImageTableProps } from "../../../biresnerf/viewer/widgets/image_table";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { shared } from "../api/http";
import { isOver } from "../jobs/state";
import { CopyButton } from "../parts/copy_button";
import { runAgainRequest } from "./actions";

type Widgets = typeof import("./widgets");

interface Props extends ImageTableProps {
  job: JobView;
  widgets: Widgets;
}

export function Images({ job, widgets, ...table }: Props) {
  const [ticked, setTicked] = useState<ReadonlySet<number>>(new Set());
  const tick = (image: number, on: boolean) => {
    setTicked((before) => new Set(on ? [...before, image] : [...before].filter((other) => other !== image)));
  };
  const chosen = table.rows.filter(({ image }) => ticked.has(image));
  const given = chosen.filter(({ source }) => source === "given");
  return (
    <>
      <widgets.ImageTable {...table} {...(isOver(job) && !shared.value && { ticked, onTick: tick })} />
      {chosen.length > 0 && (
        <p class="ticked" role="status">
          {count(chosen.length, "image")} selected
          {given.length < chosen.length && `, ${given.length} with a given pose`}
          <button type="button" class="act small" disabled={given.length === 0} onClick={() => runAgainWith(job, "fixed", given)}>
            Run again with their given poses fixed …
          </button>
          <button type="button" class="act small" onClick={() => runAgainWith(job, "leave_out", chosen)}>
            Run again without them …
          </button>
          <CopyButton text={chosen.map(({ name }) => name).join("\n")} what="of the selected images" label="Copy names" />
        </p>
      )}
    </>
  );
}

/** Opens the dialog for another run that also keeps the given poses of these images fixed, or leaves them out. */
function runAgainWith(job: JobView, option: "fixed" | "leave_out", rows: readonly ImageRow[]): void {
  const before = job.options[option];
  const names = [...(Array.isArray(before) ? before : []), ...rows.map(({ name }) => name)];
  runAgainRequest.set({ job: job.id, values: { [option]: [...new Set(names)] } });
}

/** What the page offers for a photo that deserves a look. */
export const photoActions = (job: JobView) => (row: ImageRow) => (
  <span class="photo-actions">
    {row.source === "given" && (
      <button type="button" class="act small" onClick={() => runAgainWith(job, "fixed", [row])}>
        Keep its given pose …
      </button>
    )}
    <button type="button" class="act small" onClick={() => runAgainWith(job, "leave_out", [row])}>
      Leave it out …
    </button>
  </span>
);
