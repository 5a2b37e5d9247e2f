// A checked set before its job: what was found, what will happen, photos, given cameras, and the form that submits the job.
import { useMemo, useState } from "preact/hooks";
import type { DatasetView, JobView } from "schemas";
import { useAttempt } from "../api/hooks";
import { requestJson } from "../api/http";
import { nameLabel } from "../jobs/state";
import { useMasks } from "../masks/use_masks";
import { OptionsForm } from "../options/form";
import type { Values } from "../options/schema";
import { ProblemBox } from "../parts/problem_box";
import { CheckTable } from "./check_table";
import { GivenCameras } from "../parts/given_cameras";
import { Photos } from "./photos";
import { Plan } from "./plan";
import { answeredYes, AskedPoses } from "./pose_question";
import { useSet } from "./set_photos";

const FORM = "new-job";
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
      {question && <AskedPoses question={question} yes={converted} onAnswer={convert} />}
      <div class="set-views">
        <Plan report={report} values={values} leftOut={leftOut.size} onPreset={(preset) => setValues((others) => ({ ...others, preset }))}>
          {problem && <ProblemBox problem={problem} />}
          <p class="submit">
            <button class="act primary" form={FORM} disabled={busy || masks.painted.size > 0}>
              {busy ? "Submitting …" : "Refine the poses"}
            </button>
            {masks.painted.size > 0 && <span class="soft">Save the masks first, below.</span>}
          </p>
        </Plan>
        <CheckTable dataset={dataset} cameras={photos?.list.cameras ?? []} />
      </div>
      {photos && (
        <div class="set-views">
          <Photos {...{ photos, leftOut, masks }} onChange={leaveOut} />
          {report.with_pose > 0 && (
            <section class="card panel-scene" aria-labelledby="given-heading">
              <h2 id="given-heading">Given cameras</h2>
              <GivenCameras photos={photos} converted={converted} />
            </section>
          )}
        </div>
      )}
      <form
        id={FORM}
        class="card"
        aria-label="Options"
        onSubmit={(event) => {
          event.preventDefault();
          void attempt(submit);
        }}
      >
        <h2>Options</h2>
        <OptionsForm values={values} onChange={setValues} preset={report.preset} problems={problem?.errors ?? []} />
      </form>
    </>
  );
}
