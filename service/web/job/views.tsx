// The views of a job's result or, while it runs, of its previews; one image is selected in all of them.
import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import type { ArtifactView, JobView, PosesDocument, ViewFile } from "schemas";
import { OrbitVideo } from "../../../biresnerf/viewer/result/orbit_video";
import { type UrlOf, useWidgetData } from "../../../biresnerf/viewer/result/widget_data";
import { once, useLoaded } from "../api/hooks";
import { shared } from "../api/http";
import { useStore } from "../api/store";
import { isOver } from "../jobs/state";
import { ProblemBox } from "../parts/problem_box";
import { type SetPhotos, useSet, useSetPhotos } from "../upload/set_photos";
import { Images, photoActions } from "./images";
import type { LiveState } from "./live_job";
import { Seeding } from "./seeding";
import { WaitingCameras, WaitingPhotos } from "./waiting";

export function JobViews({ seen, urlOf }: { seen: LiveState; urlOf: UrlOf }) {
  const { poses, report, view, points, history } = seen;
  const job = seen.job!;
  const guest = useStore(shared);
  const over = isOver(job);
  const stopped = over && job.state !== "succeeded";
  const { value: widgets, problem } = useLoaded(() => import("./widgets"), once, []);
  const [chosen, setChosen] = useState<number | null | undefined>(undefined);
  const first = view?.views[0]?.image ?? (poses?.images.length ? 0 : null);
  const choice = { selected: chosen === undefined ? first : chosen, onSelect: setChosen };
  const { names, cameras, centres, rows, cellOf: ownCellOf, photoOf } = useWidgetData(poses, report, view, urlOf);
  const setCellOf = useSetPhotos(guest || !poses || view?.contact_sheet ? null : job.dataset_id, names);
  const cellOf = view?.contact_sheet ? ownCellOf : setCellOf;
  const waiting = useSet(guest || over || poses ? null : job.dataset_id);
  if (problem) return <ProblemBox problem={problem} />;
  if (over && !poses && !history.length) return null;
  const scene = (
    <Panel key="scene" name="Cameras" kind="panel-scene">
      {widgets && poses ? (
        <widgets.SceneView {...{ cameras, points, cellOf, photoOf, ...choice }} />
      ) : (
        <WaitingCameras photos={waiting} words={placeholderWords(job, "cameras")} />
      )}
    </Panel>
  );
  const pictures = (
    <Panel key="pictures" name={view ? (stopped ? "Result so far" : "Result") : job.stage === "seeding" ? "Feature matches" : "Preview"} kind="panel-compare">
      {widgets && view ? (
        <widgets.ImageCompare {...{ names, centres, urlOf, stopped, ...choice }} views={view.views} />
      ) : (
        <Preview seen={seen} poses={poses} urlOf={urlOf} waiting={waiting} />
      )}
    </Panel>
  );
  return (
    <>
      {widgets && report && over && (
        <div class="panel">
          <widgets.ResultSummary {...{ report, rows, cellOf }} onSelect={setChosen} {...(!guest && { actionsOf: photoActions(job) })} />
        </div>
      )}
      <div class={view ? "job-pictures compared" : "job-pictures"}>
        {view ? [pictures, scene] : [scene, pictures]}
      </div>
      <Panel name="Progress of the run" kind="panel-curves">
        {widgets && history.length > 1 ? (
          <widgets.Curves
            lines={history}
            switchStep={report?.switch_step ?? null}
            switchReason={report?.switch_reason ?? null}
            steps={over ? (report?.steps_done ?? null) : job.progress.steps_total || null}
            ended={over ? (stopped ? "stopped" : "complete") : null}
          />
        ) : (
          <Placeholder job={job} for="curves" />
        )}
      </Panel>
      {widgets && rows.length > 0 && (
        <Panel name="Images" kind="panel-table">
          <Images {...{ job, widgets, rows, cellOf, ...choice }} />
        </Panel>
      )}
      {view?.orbit && <Flight view={view} urlOf={urlOf} />}
    </>
  );
}

/** The film, fetched when it is opened. */
function Flight({ view, urlOf }: { view: ViewFile; urlOf: UrlOf }) {
  const [open, setOpen] = useState(false);
  return (
    <details class="panel" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <h2>Flight around the scene</h2>
      </summary>
      {open && <OrbitVideo {...{ view, urlOf }} />}
    </details>
  );
}

function Panel({ name, kind, children }: { name: string; kind: string; children: ComponentChildren }) {
  return (
    <div class={`panel ${kind}`}>
      <h2>{name}</h2>
      {children}
    </div>
  );
}

/** Stands in for what is not there yet. */
function Placeholder({ job, for: what }: { job: JobView; for: string }) {
  return <p class="waiting soft">{placeholderWords(job, what)}</p>;
}

function placeholderWords(job: JobView, what: string): string {
  if (isOver(job)) return `This job has no ${what}.`;
  return job.state === "queued" ? `The ${what} appear soon after the job starts.` : `The ${what} appear once the optimisation starts.`;
}

const KINDS = ["render", "photo", "difference", "depth"] as const;

/** One view as the field renders it now. */
function Preview(props: { seen: LiveState; poses: PosesDocument | null; urlOf: UrlOf; waiting: SetPhotos | null }) {
  const { seen, poses, urlOf, waiting } = props;
  const pictures = previewPictures(seen.artifacts);
  if (!pictures.size && seen.seeding && !isOver(seen.job!)) return <Seeding seeding={seen.seeding} urlOf={urlOf} />;
  if (!pictures.size && waiting) return <WaitingPhotos job={seen.job!} photos={waiting} />;
  if (!pictures.size) return <Placeholder job={seen.job!} for="pictures" />;
  const lens = poses?.cameras[0];
  const frame = lens && { aspectRatio: `${lens.width} / ${lens.height}` };
  return (
    <ul class="preview">
      {KINDS.map((kind) => {
        const url = pictures.has(kind) ? urlOf(pictures.get(kind)!) : null;
        return (
          <li key={kind}>
            <figure>
              <div class="preview-frame" style={frame}>
                {url && <img src={url} alt={`${kind} of one view, as the field renders it now`} />}
              </div>
              <figcaption>{kind}</figcaption>
            </figure>
          </li>
        );
      })}
    </ul>
  );
}

function previewPictures(artifacts: readonly ArtifactView[]): Map<string, string> {
  const found = artifacts.map(({ name }) => /^preview\/.*_(render|photo|difference|depth)\.png$/.exec(name));
  return new Map(found.flatMap((match) => (match ? [[match[1]!, match[0]] as const] : [])));
}
