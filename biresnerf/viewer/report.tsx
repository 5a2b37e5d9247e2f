// report.html: shows the data that the library embedded in the page. Nothing is fetched.
import { render } from "preact";
import { useCallback, useMemo } from "preact/hooks";
import type { PosesDocument, Report, ViewFile } from "schemas";
import { historyOf, pointsOf } from "./result/widget_data";
import { ResultView } from "./result_view";
import { count, duration, fixed, largest, pixels } from "./widgets/numbers";
import { optionText, optionTitle, worded } from "./widgets/option_words";

/** What report_html.py embeds. */
interface Embedded {
  readonly title: string;
  readonly written: string;
  readonly poses: PosesDocument;
  readonly report: Report;
  readonly view: ViewFile | null;
  readonly history: string;
  /** Files of the result as data: URLs. */
  readonly files: Readonly<Record<string, string>>;
  /** What is not in this file, and why. */
  readonly left_out: readonly string[];
}

function bytesOf(url: string): ArrayBuffer {
  const text = atob(url.slice(url.indexOf(",") + 1));
  return Uint8Array.from(text, (character) => character.charCodeAt(0)).buffer;
}

function ReportPage({ data, licences }: { data: Embedded; licences: string }) {
  const { report, view, files } = data;
  const points = (view?.points ?? []).flatMap((entry) => {
    const url = files[entry.file];
    return url === undefined ? [] : [pointsOf(entry, bytesOf(url))];
  });
  const urlOf = useCallback((file: string) => files[file] ?? null, [files]);
  const history = useMemo(() => historyOf(data.history), [data]);
  return (
    <>
      <header class="report-head">
        <h1>
          <bdi>{data.title}</bdi>
        </h1>
        <p class="soft">{factsOf(report).join(" · ")}</p>
      </header>
      <main>
        <ResultView {...{ report, view, points, history, urlOf }} poses={data.poses} />
        <Notes title="Not in this file" lines={data.left_out} />
        <details class="panel">
          <summary>Options</summary>
          <dl class="options">
            {Object.entries(report.options).map(([key, value]) => (
              <div key={key}>
                <dt>{optionTitle(key)}</dt>
                <dd>{optionText(value)}</dd>
              </div>
            ))}
          </dl>
        </details>
      </main>
      <footer class="soft">
        BiResNeRF {report.version}, {data.written}. This file is complete; it loads nothing from elsewhere.
        <details>
          <summary>Licences of the libraries in this file</summary>
          <pre tabIndex={0}>{licences}</pre>
        </details>
      </footer>
    </>
  );
}

function factsOf(report: Report): string[] {
  const seconds = Object.values(report.seconds).reduce((a, b) => a + b, 0);
  return [
    count(report.images.length, "image"),
    `${report.options.preset}, ${report.options.method}`,
    report.state === "partial"
      ? `stopped after ${report.steps_done.toLocaleString("en-GB")} of ${count(Number(report.options.steps), "step")}`
      : count(report.steps_done, "step"),
    sizeWords(report),
    ...(report.heldout?.unshared_opacity != null
      ? [`${fixed(100 * report.heldout.unshared_opacity, 1)} % of what is rendered lies where no second camera looks`]
      : []),
    `${duration(seconds)} on ${report.device}`,
  ];
}

/** The photos' own size, and at which the field saw them. */
function sizeWords({ cameras, working_size: [width, height] }: Report): string {
  const seen = `${width} × ${height} px`;
  const own = largest(cameras);
  if (!own) return `copies of ${seen} to learn from`;
  return own.width > width ? `photos of ${pixels(own)}, learned from copies of ${seen}` : `photos of ${pixels(own)}`;
}

function Notes({ title, lines }: { title: string; lines: readonly string[] }) {
  if (lines.length === 0) return null;
  return (
    <div class="panel">
      <h2>{title}</h2>
      <ul class="notes">
        {lines.map((line) => (
          <li key={line}>{worded(line)}</li>
        ))}
      </ul>
    </div>
  );
}

const embedded = (id: string): unknown => JSON.parse(document.getElementById(id)?.textContent ?? "null");

const root = document.getElementById("report");
if (root) render(<ReportPage data={embedded("data") as Embedded} licences={String(embedded("licences"))} />, root);
