// The table of images; the job can be run again with the given poses of the ticked images kept fixed.
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
  const fix = () => runAgainFixed(job, given);
  return (
    <>
      <widgets.ImageTable {...table} {...(isOver(job) && !shared.value && { ticked, onTick: tick })} />
      {chosen.length > 0 && (
        <p class="ticked" role="status">
          {count(chosen.length, "image")} selected
          {given.length < chosen.length && `, ${given.length} with a given pose`}
          <button type="button" class="act small" disabled={given.length === 0} onClick={fix}>
            Run again with their given poses fixed …
          </button>
          <CopyButton text={chosen.map(({ name }) => name).join("\n")} what="of the selected images" label="Copy names" />
        </p>
      )}
    </>
  );
}

/** Opens the dialog for another run that keeps the given poses of these images. */
function runAgainFixed(job: JobView, rows: readonly ImageRow[]): void {
  const before = Array.isArray(job.options.fixed) ? job.options.fixed : [];
  runAgainRequest.set({ job: job.id, values: { fixed: [...new Set([...before, ...rows.map(({ name }) => name)])] } });
}

/** What the page offers for a photo that deserves a look. */
export const holdActions = (job: JobView) => (row: ImageRow) =>
  row.source === "given" && (
    <button type="button" class="act small" onClick={() => runAgainFixed(job, [row])}>
      Keep its given pose …
    </button>
  );
