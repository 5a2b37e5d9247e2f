// What a job would do with a checked set, in words; how long it takes with each preset, and the button that starts it.
import type { ComponentChildren } from "preact";
import type { CheckReport } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { Presets } from "../options/form";
import { changesTimes, type Values } from "../options/schema";

interface Props {
  report: CheckReport;
  values: Values;
  leftOut: number;
  onPreset: (preset: string) => void;
  /** What submits the job. */
  children: ComponentChildren;
}

export function Plan({ report, values, leftOut, onPreset, children }: Props) {
  const altered = changesTimes(values);
  return (
    <section class="card plan" aria-labelledby="plan-heading">
      <h2 id="plan-heading">What will happen</h2>
      <Presets preset={String(values.preset ?? report.preset)} onChange={onPreset} expected={altered ? {} : report.expected_s} />
      {!altered && <p class="soft">Times are for this machine, after the job starts and if nothing else keeps it busy.</p>}
      {children}
      <ol>
        {leftOut > 0 && <li>{count(leftOut, "photo")} of {report.images} {leftOut === 1 ? "is" : "are"} left out.</li>}
        <li>{startWords(report, String(values.start ?? "auto"))}</li>
        <li>A model of the scene is learnt from the photos (of large ones, from smaller copies), and the cameras move until photos and model agree.</li>
        <li>
          {values.verdict === false
            ? "You get the refined poses, untested."
            : report.with_pose > 0
              ? "A test on photos that were held back shows whether the refined poses are better. If not, you keep yours."
              : "A test on photos that were held back shows whether the refined poses are better than those found first."}
        </li>
      </ol>
    </section>
  );
}

/** Where the initial poses come from. */
function startWords({ images, with_pose, without_pose }: CheckReport, start: string): string {
  const missing = `${without_pose} of ${count(images, "photo")} ${without_pose === 1 ? "has" : "have"} no pose`;
  if (start === "turntable") return "The cameras start on a ring, in the order of the photos' names.";
  if (start === "given") {
    return without_pose ? `${missing}: the job will fail, as it may only start from given poses.` : "Your poses are the start.";
  }
  if (start === "none") {
    return without_pose ? `${missing}: guessed from similar photos, without feature matching.` : "Your poses are the start, without feature matching.";
  }
  if (start === "colmap" || with_pose === 0) {
    return "COLMAP matches features between the photos and finds all poses, in a frame and scale of its own.";
  }
  if (without_pose) return `${missing}: COLMAP matches features between the photos and finds them, in the frame of your ${with_pose} poses.`;
  return "Your poses are the start. COLMAP matches features between the photos; where its poses predict photos better, they take over.";
}
