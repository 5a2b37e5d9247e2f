// A finished result that comes with the service, for those who have no job yet.
import type { PosesDocument, Report, ViewFile } from "schemas";
import { historyOf, pointsOf } from "../../../biresnerf/viewer/result/widget_data";
import { once, useLoaded } from "../api/hooks";
import { address, request, requestJson } from "../api/http";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";

const fileOf = (name: string) => `example/${name}`;
/** A job of yours has these and more, among them a report to open offline. */
const DOWNLOADS = [
  ["transforms.json", "the set's own file with the refined poses, for nerfstudio and instant-ngp"],
  ["colmap.zip", "a COLMAP model, for gsplat, 3DGS, Metashape and Blender"],
  ["poses.json", "poses before and after, with the accuracy of each"],
] as const;
const urlOf = (name: string) => address(fileOf(name));

export function ExamplePage() {
  useTitle("A finished example");
  const { value: shown, problem } = useLoaded(load, once, []);
  if (problem) return <ProblemBox problem={problem} />;
  if (!shown) return <p class="soft">Loading …</p>;
  const { widgets, ...result } = shown;
  return (
    <article class="job">
      <header class="job-header">
        <h1>A finished example</h1>
        <p class="soft">
          {result.report.images.length} photos of a made scene, whose poses were turned at random, and the result. To refine a
          set yourself, choose <em>Try a sample set</em> on the <a href="#/">start page</a>.
        </p>
      </header>
      <widgets.ResultView {...result} urlOf={urlOf} />
      <section class="panel" aria-labelledby="downloads-heading">
        <h2 id="downloads-heading">Downloads</h2>
        <ul>
          {DOWNLOADS.map(([name, words]) => (
            <li key={name}>
              <a href={urlOf(name)} download={name}>
                {name}
              </a>
              : {words}
            </li>
          ))}
        </ul>
      </section>
    </article>
  );
}

async function load(signal: AbortSignal) {
  const json = <T,>(name: string) => requestJson<T>("GET", fileOf(name), { signal });
  const read = (name: string) => request("GET", fileOf(name), { signal });
  const view = await json<ViewFile>("view.json");
  const [widgets, poses, report, history, points] = await Promise.all([
    import("./widgets"),
    json<PosesDocument>(view.poses),
    json<Report>("report.json"),
    read("history.jsonl").then((response) => response.text()),
    Promise.all(view.points.map(async (entry) => pointsOf(entry, await (await read(entry.file)).arrayBuffer()))),
  ]);
  return { widgets, poses, report, view, points, history: historyOf(history) };
}
