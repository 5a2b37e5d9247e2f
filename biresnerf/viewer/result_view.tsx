// All views of one finished result: in report.html, and of the example on the service's page.
import { useState } from "preact/hooks";
import type { PosesDocument, Report, ViewFile } from "schemas";
import { OrbitVideo } from "./result/orbit_video";
import { type CurvePoint, type PointLayer, type UrlOf, useWidgetData } from "./result/widget_data";
import { SceneView } from "./scene/scene_view";
import { Curves } from "./widgets/curves";
import { ImageCompare } from "./widgets/image_compare";
import { ImageTable } from "./widgets/image_table";
import { ResultSummary } from "./widgets/result_summary";

interface Props {
  readonly poses: PosesDocument;
  readonly report: Report;
  readonly view: ViewFile | null;
  readonly points: readonly PointLayer[];
  readonly history: readonly CurvePoint[];
  readonly urlOf: UrlOf;
}

/** One image is selected in all of them. */
export function ResultView({ poses, report, view, points, history, urlOf }: Props) {
  const { names, cameras, centres, rows, cellOf, photoOf } = useWidgetData(poses, report, view, urlOf);
  const [selected, setSelected] = useState<number | null>(view?.views[0]?.image ?? (names.length > 0 ? 0 : null));
  const choice = { selected, onSelect: setSelected };
  const stopped = report.state === "partial";
  return (
    <div class="job-view">
      <div class="panel">
        <ResultSummary {...{ report, rows, cellOf }} onSelect={setSelected} />
      </div>
      <div class="job-pictures compared">
        <div class="panel panel-compare">
          <h2>{stopped ? "Result so far" : "Result"}</h2>
          <ImageCompare {...{ names, centres, urlOf, stopped }} views={view?.views ?? []} {...choice} />
        </div>
        <div class="panel panel-scene">
          <h2>Cameras</h2>
          <SceneView {...{ cameras, points, cellOf, photoOf, ...choice }} />
        </div>
      </div>
      {view?.orbit && urlOf(view.orbit) && (
        <div class="panel">
          <h2>Flight around the scene</h2>
          <OrbitVideo {...{ view, urlOf }} />
        </div>
      )}
      <div class="panel">
        <h2>Images</h2>
        <ImageTable rows={rows} cellOf={cellOf} {...choice} />
      </div>
      <div class="panel">
        <h2>Progress of the run</h2>
        <Curves lines={history} switchStep={report.switch_step} switchReason={report.switch_reason} steps={report.steps_done} ended={stopped ? "stopped" : "complete"} />
      </div>
    </div>
  );
}
