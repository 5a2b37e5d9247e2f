// The table of images; the job can be run again with the given poses of the ticked images kept fixed.
import { useState } from "preact/hooks";
import type { JobView } from "schemas";
import type { ImageTableProps } from "../../../biresnerf/viewer/widgets/image_table";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
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
  const fix = () => {
    const before = Array.isArray(job.options.fixed) ? job.options.fixed : [];
    const fixed = [...new Set([...before, ...given.map(({ name }) => name)])];
    runAgainRequest.set({ job: job.id, values: { fixed } });
  };
  return (
    <>
      <widgets.ImageTable {...table} {...(isOver(job) && { ticked, onTick: tick })} />
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
