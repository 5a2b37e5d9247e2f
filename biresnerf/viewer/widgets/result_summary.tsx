// The answer of a result: the verdict, its plain figures, warnings, and the photos that deserve a look.
import type { ComponentChildren } from "preact";
import type { PairedDifference, PartsReport, Report } from "schemas";
import type { ImageRow, SheetCell } from "../result/widget_data";
import { count, fixed, median, short, signed } from "./numbers";
import { worded } from "./option_words";
import { Thumb } from "./thumb";
import { Evidence, VerdictSentence } from "./verdict";
import { ADVICE, ALARMING, type Flag } from "./words";

const CARDS_AT_FIRST = 6;

export interface ResultSummaryProps {
  readonly report: Report;
  readonly rows: readonly ImageRow[];
  readonly cellOf: (image: number) => SheetCell | null;
  readonly onSelect: (image: number | null) => void;
  /** What can be done about a photo, where anything can. */
  readonly actionsOf?: (row: ImageRow) => ComponentChildren;
}

export function ResultSummary({ report, rows, cellOf, onSelect, actionsOf }: ResultSummaryProps) {
  // What is true of most photos is said of the set, in the figures and warnings.
  const rare = [...ALARMING].filter((flag) => 2 * rows.filter(({ flags }) => flags.includes(flag)).length <= rows.length);
  const doubtful = rows.flatMap((row) => {
    const flags = rare.filter((flag) => row.flags.includes(flag));
    return flags.length ? [{ row, flags }] : [];
  });
  return (
    <section class="verdict" aria-label="Verdict">
      {(report.faults ?? []).length > 0 && (
        <div role="alert" aria-label="What failed">
          <ul class="warnings faults">
            {report.faults.map((fault) => (
              <li key={fault.code}>
                <strong>{fault.detail}</strong> {fault.hint}
              </li>
            ))}
          </ul>
        </div>
      )}
      <VerdictSentence report={report} />
      <FigureList figures={figuresOf(report, rows)} />
      {report.warnings.length > 0 && (
        <ul class="warnings" aria-label="Warnings">
          {report.warnings.map((warning) => (
            <li key={warning}>{worded(warning)}</li>
          ))}
        </ul>
      )}
      {doubtful.length > 0 && (
        <div class="doubtful">
          <h3>{count(doubtful.length, "photo")} to look at</h3>
          <ul>
            {doubtful.slice(0, CARDS_AT_FIRST).map(({ row, flags }) => (
              <Doubtful key={row.image} {...{ row, flags, onSelect }} cell={cellOf(row.image)} actions={actionsOf?.(row)} />
            ))}
          </ul>
          {doubtful.length > CARDS_AT_FIRST && (
            <p class="soft">{doubtful.length - CARDS_AT_FIRST} more have a red flag in the table of images.</p>
          )}
        </div>
      )}
      <Evidence verdict={report.verdict} />
      <details class="evidence">
        <summary>More figures</summary>
        <FigureList figures={moreFiguresOf(report, rows)} />
      </details>
    </section>
  );
}

function FigureList({ figures }: { figures: readonly Figure[] }) {
  return (
    <dl class="figures">
      {figures.map(({ name, value, note }) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
          <dd class="soft">{note}</dd>
        </div>
      ))}
    </dl>
  );
}

function Doubtful(props: {
  row: ImageRow;
  flags: readonly Flag[];
  cell: SheetCell | null;
  onSelect: (image: number) => void;
  actions: ComponentChildren;
}) {
  const { row, flags, cell, onSelect, actions } = props;
  return (
    <li>
      <Thumb cell={cell} size={64} />
      <div>
        <button type="button" class="link" onClick={() => onSelect(row.image)}>
          <bdi>{row.name}</bdi>
        </button>
        {flags.map((flag) => (
          <p key={flag}>{ADVICE[flag]}</p>
        ))}
        {actions}
      </div>
    </li>
  );
}

interface Figure {
  readonly name: string;
  readonly value: string;
  readonly note: string;
}

/** What a person asks first: how exact, how many, and by what it was seen. */
function figuresOf(report: Report, rows: readonly ImageRow[]): Figure[] {
  const known = report.images.filter(({ confirmed }) => confirmed != null);
  const bounds = rows.flatMap(({ rotation_90 }) => (rotation_90 === null ? [] : [rotation_90]));
  const error = report.verdict?.epipolar?.error_px;
  const gain = report.verdict?.heldout?.psnr;
  return [
    ...(bounds.length ? [{ name: "Poses exact to", value: `± ${short(median(bounds), 2)}°`, note: positionWords(report, rows) }] : []),
    ...(known.length
      ? [
          {
            name: "Photos confirmed",
            value: `${known.filter(({ confirmed }) => confirmed).length} of ${rows.length}`,
            note: "by matches or by the photo itself",
          },
        ]
      : []),
    ...(error
      ? [{ name: "Matching error", value: `${short(error.before, 2)} → ${short(error.after, 2)} px`, note: "typical, in full-size photos" }]
      : []),
    ...(gain ? [{ name: "Unseen views gain", value: `${signed(gain.difference, 1)} dB`, note: sureWords(gain) }] : []),
  ];
}

/** How exact positions are: in percent of the cameras' distance, or in metres where they are known. */
function positionWords(report: Report, rows: readonly ImageRow[]): string {
  const shares = report.images.flatMap(({ uncertainty }) => uncertainty?.position_percent ?? []);
  const positions = rows.flatMap(({ position_90 }) => (position_90 === null ? [] : [position_90]));
  const metres = report.known_scale?.metres_per_unit ?? null;
  const position =
    metres !== null && positions.length
      ? `${short(metres * median(positions)!, 2)} m`
      : shares.length
        ? `${short(median(shares), 2)} % of the distance`
        : positions.length
          ? `${short(median(positions), 2)} units`
          : null;
  return position === null ? "nine times in ten" : `and ± ${position}, nine times in ten`;
}

/** What tells of the run rather than of the poses. */
function moreFiguresOf(report: Report, rows: readonly ImageRow[]): Figure[] {
  const turned = rows.map((row) => row.moved_deg);
  const kept = (report.verdict ?? report.verdict_so_far)?.returned === "input";
  return [
    {
      name: kept ? "Refined cameras differ by" : "Cameras turned by",
      value: `${short(median(turned), 2)}°`,
      note: `typical; ${short(Math.max(...turned), 2)}° at most`,
    },
    ...(report.parts ? [partsFigure(report.parts)] : []),
    ...(report.heldout
      ? [{ name: "Final render", value: `${fixed(report.heldout.psnr, 1)} dB`, note: `PSNR of ${count(report.heldout.count, "unseen view")}` }]
      : []),
  ];
}

/** How well the parts agree that a large set was joined from. */
function partsFigure({ parts, seams = [] }: PartsReport): Figure {
  const joined = `${parts.filter(({ why_not }) => why_not == null).length} of ${count(parts.length, "part")} joined`;
  const [worst] = [...seams].sort((a, b) => b.rotation_deg_worst - a.rotation_deg_worst);
  return {
    name: "Parts agree to",
    value: worst ? `${short(median(seams.map((seam) => seam.rotation_deg)), 2)}°` : "–",
    note: worst ? `on shared photos, ${short(worst.rotation_deg_worst, 2)}° at most (${worst.parts.join(", ")}); ${joined}` : joined,
  };
}

/** How sure a gain in PSNR is. */
function sureWords({ low, high, count: views }: PairedDifference): string {
  const test = `in the test on ${count(views, "view")}`;
  return low === null || high === null ? test : `${signed(low, 1)} to ${signed(high, 1)} dB (95 % interval), ${test}`;
}
