// One row an image; of those that are ticked the job can be run again with their poses held.
import { useState } from "preact/hooks";
import type { JobView } from "schemas";
import type { ImageTableProps } from "../../../biresnerf/viewer/widgets/image_table";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { isOver } from "../jobs/state";
import { CopyButton } from "../parts/copy_button";
import { wishedAgain } from "./actions";

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
  const hold = () => {
    const before = Array.isArray(job.options.fixed) ? job.options.fixed : [];
    const fixed = [...new Set([...before, ...given.map(({ name }) => name)])];
    wishedAgain.set({ job: job.id, values: { fixed } });
  };
  return (
    <>
      <widgets.ImageTable {...table} {...(isOver(job) && { ticked, onTick: tick })} />
      {chosen.length > 0 && (
        <p class="ticked" role="status">
          {count(chosen.length, "image")} chosen
          {given.length < chosen.length && `, ${given.length} with a given pose`}
          <button type="button" class="act small" disabled={given.length === 0} onClick={hold}>
            Run again with their given poses held …
          </button>
          <CopyButton text={chosen.map(({ name }) => name).join("\n")} what="of the chosen images" label="Copy names" />
        </p>
      )}
    </>
  );
}
