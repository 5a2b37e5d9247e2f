// The result of the service's check of an image set, as far as it is known.
import type { ComponentChildren } from "preact";
import type { CheckedCamera, CheckReport, DatasetView } from "schemas";
import { count, largest, pixels } from "../../../biresnerf/viewer/widgets/numbers";
import { worded } from "../../../biresnerf/viewer/widgets/option_words";
import { bytes, percent } from "../parts/format";

type Mark = "good" | "note" | "bad" | "wait";
const MARKS: Record<Mark, [string, string]> = {
  good: ["✓", "good"],
  note: ["!", "note"],
  bad: ["✕", "wrong"],
  wait: ["…", "not known yet"],
};
const INTRINSICS: Record<string, string> = {
  given: "given",
  maker: "as the drone's maker measured them",
  exif: "from EXIF",
  predicted: "predicted by a network, and refined with the poses",
  colmap: "from COLMAP",
  guessed: "guessed, and refined with the poses",
};

/** What the report calls the format of photos without poses. */
const ALONE = "images";
const modelWords = (model: string) => model.toLowerCase().replaceAll("_", " ");
/** Known once all photos are read. */
const LATER = ["Poses", "Cameras", "Masks"];

interface Props {
  dataset: DatasetView;
  /** Once they are known. */
  cameras?: readonly CheckedCamera[];
}

export function CheckTable({ dataset, cameras = [] }: Props) {
  const { report } = dataset;
  const checking = dataset.state === "finalizing";
  const rejected = dataset.state === "rejected";
  return (
    <section class="card" aria-label="Check of the image set">
      <h2>
        Check{" "}
        <span class={`chip chip-${rejected ? "bad" : report ? "good" : "plain"}`} role="status">
          {rejected ? "rejected" : report ? "ready" : checking ? "checking every image …" : "waiting for files"}
        </span>
      </h2>
      <table class="checks">
        <tbody>
          <Line mark={dataset.missing.length ? "wait" : "good"} name="Files">
            {count(dataset.files, "file")}, {bytes(dataset.bytes)}
            {dataset.missing.length > 0 && `; ${dataset.missing.length} to come`}
          </Line>
          {report && <Found {...{ report, cameras }} />}
          {!report && !rejected && (
            <>
              <Line mark="wait" name="Images">
                <Read dataset={dataset} />
              </Line>
              {LATER.map((name) => (
                <Line key={name} mark="wait" name={name}>
                  <span class="soft">not known yet</span>
                </Line>
              ))}
            </>
          )}
        </tbody>
      </table>
    </section>
  );
}

/** How many photos of how many the check has read. */
function Read({ dataset: { state, checked } }: { dataset: DatasetView }) {
  if (!checked) return <span class="soft">{state === "finalizing" ? "looking for photos and poses …" : "not known yet"}</span>;
  const { photos_read, photos } = checked;
  return (
    <>
      <p class="number">
        {photos_read < photos ? `${photos_read} of ${count(photos, "photo")} read` : `${count(photos, "photo")} read; comparing them …`}
      </p>
      <progress max={photos} value={photos_read} aria-label="Photos read">
        {percent(photos_read / photos)}
      </progress>
    </>
  );
}

function Found({ report, cameras }: { report: CheckReport; cameras: readonly CheckedCamera[] }) {
  const posed = report.with_pose;
  const own = largest(cameras);
  return (
    <>
      <Line mark="good" name="Images">
        {count(report.images, "image")}
        {own && ` of ${new Set(cameras.map(pixels)).size > 1 ? "up to " : ""}${pixels(own)}`}, all readable{report.format !== ALONE && `; poses from ${report.format}`}
      </Line>
      <Line mark={report.without_pose ? "note" : "good"} name="Poses">
        {posed} of {report.images} given
        {posed === 0 && "; COLMAP will find them first"}
        {posed > 0 && report.without_pose > 0 && "; the others will be found"}
      </Line>
      <Line mark="good" name="Cameras">
        {count(report.cameras, "camera")}: {report.camera_models.map(modelWords).join(", ")}; lens{" "}
        {report.intrinsics.map((source) => INTRINSICS[source] ?? source).join(", ")}
      </Line>
      <Line mark="good" name="Masks">
        {report.masks ? count(report.masks, "mask") : "none"}
        {report.transparency && "; transparent images, on a white background"}
      </Line>
      {report.warnings.map((warning) => (
        <Line key={warning} mark="note" name="Warning">
          {worded(warning)}
        </Line>
      ))}
    </>
  );
}

function Line({ mark, name, children }: { mark: Mark; name: string; children: ComponentChildren }) {
  const [sign, word] = MARKS[mark];
  return (
    <tr>
      <td class={`mark ${mark}`}>
        <span aria-hidden="true">{sign}</span>
        <span class="unseen">{word}</span>
      </td>
      <th scope="row">{name}</th>
      <td>{children}</td>
    </tr>
  );
}
