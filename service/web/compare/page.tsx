// Two jobs side by side: figures, options that differ, curves laid over each other, differences of poses.
import { useMemo } from "preact/hooks";
import type { ArtifactList, JobView, PosesDocument, Report } from "schemas";
import { differencesOf } from "../../../biresnerf/viewer/result/align";
import { type CurvePoint, historyOf } from "../../../biresnerf/viewer/result/widget_data";
import { ScrolledTable } from "../../../biresnerf/viewer/widgets/controls";
import { count, duration, fixed, median, short } from "../../../biresnerf/viewer/widgets/numbers";
import { optionText, optionTitle } from "../../../biresnerf/viewer/widgets/option_words";
import { once, useLoaded } from "../api/hooks";
import { Problem, request, requestJson } from "../api/http";
import { Chip, titleOf } from "../jobs/state";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";

export interface Side {
  readonly job: JobView;
  readonly report: Report;
  readonly poses: PosesDocument;
  readonly history: readonly CurvePoint[];
}

export function ComparePage({ ids }: { ids: readonly [string, string] }) {
  const { value: sides, problem } = useLoaded((signal) => Promise.all(ids.map((id) => loadSide(id, signal))), once, [ids.join()]);
  const { value: curves } = useLoaded(() => import("./curves"), once, []);
  useTitle("Comparison");
  if (problem) return <ProblemBox problem={problem} />;
  const [first, second] = sides ?? [];
  if (!first || !second) return <p class="soft">Loading …</p>;
  return (
    <article class="job">
      <header class="page-head">
        <h1>Two jobs compared</h1>
      </header>
      <div class="panel">
        <Figures sides={[first, second]} />
      </div>
      <div class="panel">
        <h2>Fit to the photos</h2>
        {curves ? <curves.OverlaidCurves sides={[first, second]} /> : <p class="waiting soft">Loading …</p>}
      </div>
      <div class="panel">
        <h2>Where the poses differ</h2>
        <PoseTable first={first} second={second} />
      </div>
    </article>
  );
}

async function loadSide(id: string, signal: AbortSignal): Promise<Side> {
  const job = await requestJson<JobView>("GET", `v1/jobs/${id}`, { signal });
  const { items } = await requestJson<ArtifactList>("GET", `v1/jobs/${id}/artifacts`, { signal });
  const file = async (name: string) => {
    const found = items.find((item) => item.name === name);
    if (!found) {
      const detail = `${titleOf(job)} has no ${name}.`;
      const hint = "Compare jobs that have ended with a result.";
      throw new Problem({ status: 404, code: "no_result", title: "There is nothing to compare", detail, hint });
    }
    return request("GET", `${found.href}?redirect=false`, { signal });
  };
  const report = (await (await file("report.json")).json()) as Report;
  // What was refined, whatever the verdict returned.
  const refined = items.some(({ name }) => name === "refined/poses.json") ? "refined/poses.json" : "poses.json";
  const poses = (await (await file(refined)).json()) as PosesDocument;
  return { job, report, poses, history: historyOf(await (await file("history.jsonl")).text()) };
}

type Sides = readonly [Side, Side];

const FIGURES: readonly { name: string; of: (side: Side) => string }[] = [
  { name: "Unseen views in the before/after test", of: ({ report }) => psnr(report.verdict?.heldout?.psnr.after) },
  { name: "Matching error", of: ({ report }) => unit(short(report.verdict?.epipolar?.error_px.after ?? null, 2), "px") },
  { name: "Final render, held-out views", of: ({ report }) => psnr(report.heldout?.psnr) },
  { name: "Cameras turned by (median)", of: ({ report }) => unit(short(median(report.images.map((image) => image.moved_deg)), 2), "°") },
  { name: "Photos", of: ({ report }) => String(report.images.length) },
  { name: "Steps", of: ({ report }) => String(report.steps_done) },
  { name: "Time", of: ({ report }) => duration(Object.values(report.seconds).reduce((a, b) => a + b, 0)) },
];
const psnr = (value: number | null | undefined) => unit(fixed(value ?? null, 2), "dB");
const unit = (text: string, name: string) => (text === "–" ? text : name === "°" ? `${text}°` : `${text} ${name}`);

function Figures({ sides }: { sides: Sides }) {
  const options = sides.map(({ report }) => report.options as Readonly<Record<string, unknown>>);
  const differing = Object.keys(options[0] ?? {}).filter((name) => optionText(options[0]?.[name]) !== optionText(options[1]?.[name]));
  return (
    <ScrolledTable label="Figures of both jobs">
      <thead>
        <tr>
          <td />
          {sides.map(({ job }, index) => (
            <th scope="col" key={index}>
              <i class={`dash compare-${index}`} /> <a href={`#/jobs/${job.id}`}>{titleOf(job)}</a> <Chip job={job} />
            </th>
          ))}
        </tr>
      </thead>
      <tbody>
        {FIGURES.map(({ name, of }) => (
          <Row key={name} name={name} texts={sides.map(of)} />
        ))}
        {differing.map((name) => (
          <Row key={name} name={`Option “${optionTitle(name)}”`} texts={options.map((values) => optionText(values[name]))} />
        ))}
      </tbody>
    </ScrolledTable>
  );
}

function Row({ name, texts }: { name: string; texts: readonly string[] }) {
  return (
    <tr>
      <th scope="row">{name}</th>
      {texts.map((each, index) => (
        <td key={index}>{each}</td>
      ))}
    </tr>
  );
}

function PoseTable({ first, second }: { first: Side; second: Side }) {
  const { images, aligned } = useMemo(() => differencesOf(first.poses, second.poses), [first, second]);
  const largest = useMemo(() => [...images].sort((a, b) => b.turned_deg - a.turned_deg), [images]);
  const turned = median(images.map(({ turned_deg }) => turned_deg));
  return (
    <>
      <p>
        {count(images.length, "photo")} in both: poses differ by {short(turned, 2)}° (median), {short(largest[0]?.turned_deg ?? null, 2)}° at most.
        {aligned && " Neither frame was given, so the second was moved onto the first."}
      </p>
      <ScrolledTable label="Differences of poses">
        <thead>
          <tr>
            <th scope="col">photo</th>
            <th scope="col" class="number">
              rotation °
            </th>
            <th scope="col" class="number">
              distance, units
            </th>
          </tr>
        </thead>
        <tbody>
          {largest.map(({ name, turned_deg, moved }) => (
            <tr key={name}>
              <th scope="row">
                <bdi>{name}</bdi>
              </th>
              <td class="number">{short(turned_deg)}</td>
              <td class="number">{short(moved)}</td>
            </tr>
          ))}
        </tbody>
      </ScrolledTable>
    </>
  );
}
