// Two jobs side by side: which result is better and why, in the service's words; curves laid over each other.
import type { ArtifactList, ComparedFigure, Comparison, JobView } from "schemas";
import { type CurvePoint, historyOf } from "../../../biresnerf/viewer/result/widget_data";
import { ScrolledTable } from "../../../biresnerf/viewer/widgets/controls";
import { count, median, short } from "../../../biresnerf/viewer/widgets/numbers";
import { once, useLoaded } from "../api/hooks";
import { request, requestJson } from "../api/http";
import { Chip, titleOf } from "../jobs/state";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";

export interface Side {
  readonly job: JobView;
  readonly history: readonly CurvePoint[];
}

type Sides = readonly [Side, Side];

interface Loaded {
  readonly sides: Sides;
  readonly compared: Comparison;
}

export function ComparePage({ ids }: { ids: readonly [string, string] }) {
  const { value, problem } = useLoaded((signal) => load(ids, signal), once, [ids.join()]);
  const { value: curves } = useLoaded(() => import("./curves"), once, []);
  useTitle("Comparison");
  if (problem) return <ProblemBox problem={problem} />;
  if (!value) return <p class="soft">Loading …</p>;
  const { sides, compared } = value;
  return (
    <article class="job">
      <header class="page-head">
        <h1>Two jobs compared</h1>
      </header>
      <section class="panel" aria-label="Conclusion">
        <p class="verdict-sentence">{compared.conclusion}</p>
        {compared.why.length > 0 && (
          <ul>
            {compared.why.map((ground) => (
              <li key={ground}>{ground}</li>
            ))}
          </ul>
        )}
      </section>
      <div class="panel">
        <h2>What differs</h2>
        <Figures sides={sides} compared={compared} />
      </div>
      <div class="panel">
        <h2>Fit to the photos</h2>
        {curves ? <curves.OverlaidCurves sides={sides} /> : <p class="waiting soft">Loading …</p>}
      </div>
      <div class="panel">
        <h2>Where the poses differ</h2>
        <PoseTable compared={compared} />
      </div>
    </article>
  );
}

async function load([first, second]: readonly [string, string], signal: AbortSignal): Promise<Loaded> {
  // Says what is wrong with a job that cannot be compared.
  const compared = await requestJson<Comparison>("GET", `v1/jobs/${first}/comparison/${second}`, { signal });
  const sides = await Promise.all([loadSide(first, signal), loadSide(second, signal)]);
  return { sides, compared };
}

async function loadSide(id: string, signal: AbortSignal): Promise<Side> {
  const job = await requestJson<JobView>("GET", `v1/jobs/${id}`, { signal });
  const { items } = await requestJson<ArtifactList>("GET", `v1/jobs/${id}/artifacts`, { signal });
  const curve = items.find(({ name }) => name === "history.jsonl");
  const text = curve ? await (await request("GET", `${curve.href}?redirect=false`, { signal })).text() : "";
  return { job, history: historyOf(text) };
}

function Figures({ sides, compared: { figures } }: { sides: Sides; compared: Comparison }) {
  return (
    <ScrolledTable label="Figures of both jobs">
      <thead>
        <tr>
          <td />
          {sides.map(({ job }, index) => (
            <th scope="col" key={index}>
              <i class={`dash compare-${index}`} /> {index === 0 ? "First" : "Second"}: <a href={`#/jobs/${job.id}`}>{titleOf(job)}</a>{" "}
              <Chip job={job} />
            </th>
          ))}
        </tr>
      </thead>
      <tbody>
        {figures.map((figure) => (
          <Row key={figure.name} figure={figure} />
        ))}
      </tbody>
    </ScrolledTable>
  );
}

function Row({ figure: { name, first, second, better } }: { figure: ComparedFigure }) {
  const mark = <span class="chip chip-good">better</span>;
  return (
    <tr>
      <th scope="row">{name}</th>
      <td>
        {first} {better === "first" && mark}
      </td>
      <td>
        {second} {better === "second" && mark}
      </td>
    </tr>
  );
}

function PoseTable({ compared: { poses, photos } }: { compared: Comparison }) {
  const turned = poses.map(({ turned_deg }) => turned_deg);
  return (
    <>
      <p>
        {count(photos, "photo")} in both: poses differ by {short(median(turned), 2)}° (median), {short(turned[0] ?? null, 2)}° at most. The second
        result was aligned with the first, so a turn that all cameras share is not counted.
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
            <th scope="col" />
          </tr>
        </thead>
        <tbody>
          {poses.map(({ name, turned_deg, moved, contradicts }) => (
            <tr key={name}>
              <th scope="row">
                <bdi>{name}</bdi>
              </th>
              <td class="number">{short(turned_deg)}</td>
              <td class="number">{short(moved)}</td>
              <td>{contradicts && <span class="flag flag-bad">one is wrong</span>}</td>
            </tr>
          ))}
        </tbody>
      </ScrolledTable>
    </>
  );
}
