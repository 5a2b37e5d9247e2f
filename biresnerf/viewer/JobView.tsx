// Everything there is to see of a result, with one image chosen in all of it.
import { useMemo, useState } from "preact/hooks";
import { Curves } from "./Curves";
import { ImageCompare } from "./ImageCompare";
import { ImageTable } from "./ImageTable";
import { SceneView } from "./SceneView";
import { VerdictSentence } from "./VerdictSentence";
import { camerasOf, cellsOf, centresOf, rowsOf } from "./job_data";
import type { JobViewProps } from "./types";

export function JobView({ poses, report, view, history, points, urlOf }: JobViewProps) {
  const [selected, setSelected] = useState<number | null>(view?.views[0]?.image ?? (poses.images.length > 0 ? 0 : null));
  const cameras = useMemo(() => camerasOf(poses, report), [poses, report]);
  const centres = useMemo(() => centresOf(poses), [poses]);
  const rows = useMemo(() => rowsOf(report), [report]);
  const cellOf = useMemo(() => cellsOf(view, poses.images.length, urlOf), [view, poses, urlOf]);
  const names = useMemo(() => poses.images.map((image) => image.name), [poses]);
  const choice = { selected, onSelect: setSelected };
  return (
    <div class="job-view">
      <VerdictSentence verdict={report.verdict} state={report.state} asked={report.options.verdict !== false} />
      <div class="job-pictures">
        <div class="panel panel-scene">
          <h2>Cameras</h2>
          <SceneView cameras={cameras} points={points} {...choice} />
        </div>
        <div class="panel panel-compare">
          <h2>Photo and render</h2>
          <ImageCompare names={names} views={view?.views ?? []} centres={centres} urlOf={urlOf} {...choice} />
        </div>
      </div>
      <div class="panel">
        <h2>Images</h2>
        <ImageTable rows={rows} cellOf={cellOf} {...choice} />
      </div>
      <div class="panel">
        <h2>The run</h2>
        <Curves
          lines={history}
          switchStep={report.switch_step}
          switchReason={report.switch_reason}
          steps={report.steps_done}
        />
      </div>
    </div>
  );
}
