// A checked set before its job: what was found, what will happen, photos, given cameras, and the form that submits the job.
import { useMemo, useState } from "preact/hooks";
import type { DatasetView, JobView } from "schemas";
import { bordersOf } from "../../../biresnerf/viewer/result/poses";
import type { SceneCamera } from "../../../biresnerf/viewer/result/widget_data";
import { once, useAttempt, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { nameLabel } from "../jobs/state";
import { useMasks } from "../masks/use_masks";
import { OptionsForm } from "../options/form";
import type { Values } from "../options/schema";
import { ProblemBox } from "../parts/problem_box";
import { CheckTable } from "./check_table";
import { Photos } from "./photos";
import { Plan } from "./plan";
import { answeredYes, AskedPoses } from "./pose_question";
import { type SetPhotos, useSet } from "./set_photos";

/** Options chosen before a set was masked, by the id of the masked one. */
const carried = new Map<string, Values>();

export function NewJob({ dataset }: { dataset: DatasetView }) {
  const { attempt, busy, problem } = useAttempt();
  const photos = useSet(dataset.id);
  const report = dataset.report!;
  const [values, setValues] = useState<Values>(carried.get(dataset.id) ?? { preset: report.preset });
  const named = values.leave_out;
  const leftOut = useMemo(() => new Set(Array.isArray(named) ? named.map(String) : []), [named]);
  const leaveOut = (names: ReadonlySet<string>) => {
    setValues(({ leave_out: _, ...others }) => (names.size ? { ...others, leave_out: [...names] } : others));
  };
  const question = report.pose_question;
  const converted = answeredYes(question, values);
  const convert = (yes: boolean) => {
    setValues(({ given_poses: _, ...others }) => (yes && question ? { ...others, given_poses: question.given_poses } : others));
  };
  const masks = useMasks(dataset, photos?.list ?? null, (id) => {
    carried.set(id, values);
    location.hash = `#/datasets/${id}`;
  });
  const submit = async () => {
    const json = { dataset_id: dataset.id, options: values, labels: nameLabel(dataset.name) };
    location.hash = `#/jobs/${(await requestJson<JobView>("POST", "v1/jobs", { json })).id}`;
  };
  return (
    <>
      <div class="set-views">
        <CheckTable dataset={dataset} />
        <Plan report={report} values={values} leftOut={leftOut.size} />
      </div>
      {question && <AskedPoses question={question} yes={converted} onAnswer={convert} />}
      {photos && (
        <div class="set-views">
          <Photos {...{ photos, leftOut, masks }} onChange={leaveOut} />
          {report.with_pose > 0 && <Cameras photos={photos} converted={converted} />}
        </div>
      )}
      <form
        class="card"
        aria-label="Options"
        onSubmit={(event) => {
          event.preventDefault();
          void attempt(submit);
        }}
      >
        <h2>Options</h2>
        <OptionsForm values={values} onChange={setValues} expected={report.expected_s} problems={problem?.errors ?? []} />
        {problem && <ProblemBox problem={problem} />}
        <p class="submit">
          <button class="act primary" disabled={busy || masks.painted.size > 0}>
            {busy ? "Submitting …" : "Refine the poses"}
          </button>
          {masks.painted.size > 0 && <span class="soft">Save the masks first, above.</span>}
        </p>
      </form>
    </>
  );
}

/** The given cameras in three dimensions; the code for it is loaded for sets that have poses. */
function Cameras({ photos: { list, cellOf }, converted }: { photos: SetPhotos; converted: boolean }) {
  const { value: widgets } = useLoaded(() => import("../job/widgets"), once, []);
  const [selected, setSelected] = useState<number | null>(null);
  const posed = useMemo(() => list.photos.flatMap(({ world_from_cam }, index) => (world_from_cam ? [index] : [])), [list]);
  const cameras = useMemo<SceneCamera[]>(() => {
    const borders = list.cameras.map(bordersOf);
    return posed.map((index) => {
      const { name, camera, world_from_cam, read_as_asked } = list.photos[index]!;
      const pose = (converted && read_as_asked) || world_from_cam!;
      return {
        ...{ name, before: null, after: pose, returned: pose, source: "given", borders: borders[camera]! },
        ...{ moved_deg: 0, moved_units: 0, delta_psnr: null, flags: [], uncertainty: null },
      };
    });
  }, [list, posed, converted]);
  const cellOfPosed = useMemo(() => (camera: number) => cellOf(posed[camera]!), [cellOf, posed]);
  return (
    <section class="card panel-scene" aria-labelledby="given-heading">
      <h2 id="given-heading">Given cameras</h2>
      {widgets ? (
        <widgets.SceneView cameras={cameras} cellOf={cellOfPosed} selected={selected} onSelect={setSelected} />
      ) : (
        <p class="waiting soft">Loading …</p>
      )}
    </section>
  );
}
