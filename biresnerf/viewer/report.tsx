// report.html: reads the data that the library wrote into the page, and shows it. Nothing is fetched.
import { render } from "preact";
import { JobView } from "./JobView";
import { historyOf, pointsOf } from "./job_data";
import { count, duration, fixed } from "./numbers";
import type { PosesFile, ReportFile, ViewFile } from "./types";

/** What report_html.py embeds. */
interface Embedded {
  readonly title: string;
  readonly written: string;
  readonly poses: PosesFile;
  readonly report: ReportFile;
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

function Report({ data, licences }: { data: Embedded; licences: string }) {
  const { report, view, files } = data;
  const points = (view?.points ?? []).flatMap((entry) => {
    const url = files[entry.file];
    return url === undefined ? [] : [pointsOf(entry, bytesOf(url))];
  });
  const orbit = view?.orbit ? files[view.orbit] : undefined;
  return (
    <>
      <header class="report-head">
        <h1>
          <bdi>{data.title}</bdi>
        </h1>
        <p class="soft">{factsOf(report).join(" · ")}</p>
      </header>
      <main>
        <JobView
          poses={data.poses}
          report={report}
          view={view}
          history={historyOf(data.history)}
          points={points}
          urlOf={(file) => files[file] ?? null}
        />
        {orbit && (
          <div class="panel">
            <h2>Orbit</h2>
            <video class="orbit" src={orbit} poster={files[view?.views[0]?.pictures.render ?? ""]} controls loop muted playsInline aria-label="A flight around the scene" />
          </div>
        )}
        <Notes title="Warnings" lines={report.warnings} />
        <Notes title="Not in this file" lines={data.left_out} />
        <details class="panel">
          <summary>Options</summary>
          <dl class="options">
            {Object.entries(report.options).map(([key, value]) => (
              <div key={key}>
                <dt>{key}</dt>
                <dd>{typeof value === "string" ? value : JSON.stringify(value)}</dd>
              </div>
            ))}
          </dl>
        </details>
      </main>
      <footer class="soft">
        BiResNeRF {report.version}, {data.written}. All of it is in this file; nothing is loaded from elsewhere.
        <details>
          <summary>Licences of the libraries in this file</summary>
          <pre tabIndex={0}>{licences}</pre>
        </details>
      </footer>
    </>
  );
}

function factsOf(report: ReportFile): string[] {
  const seconds = Object.values(report.seconds).reduce((a, b) => a + b, 0);
  return [
    count(report.images.length, "image"),
    `${report.options.preset}, ${report.options.method}`,
    count(report.steps_done, "step"),
    `${report.working_size[0]} × ${report.working_size[1]} px`,
    ...(report.heldout ? [`held-out PSNR ${fixed(report.heldout.psnr, 2)} dB, SSIM ${fixed(report.heldout.ssim, 3)}`] : []),
    `${duration(seconds)} on ${report.device}`,
  ];
}

function Notes({ title, lines }: { title: string; lines: readonly string[] }) {
  if (lines.length === 0) return null;
  return (
    <div class="panel">
      <h2>{title}</h2>
      <ul class="notes">
        {lines.map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
    </div>
  );
}

const embedded = (id: string): unknown => JSON.parse(document.getElementById(id)?.textContent ?? "null");

const root = document.getElementById("report");
if (root) render(<Report data={embedded("data") as Embedded} licences={String(embedded("licences"))} />, root);
