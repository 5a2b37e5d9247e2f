// Curves of the run: fit to the photos, motion of the cameras, and what decides when stage 2 begins.
import { useEffect, useMemo, useRef } from "preact/hooks";
import type uPlot from "uplot";
import type { CurvePoint } from "../result/widget_data";
import { chartAxis, chartIn } from "./chart";
import { fixed, short } from "./numbers";
import { themeColour, useDark } from "./theme";

interface CurvesProps {
  readonly lines: readonly CurvePoint[];
  /** First step of stage 2, once known. */
  readonly switchStep?: number | null;
  readonly switchReason?: "stable" | "cap" | null;
  /** Total steps of the run, if known: the axis then includes the steps to come. */
  readonly steps?: number | null;
  /** How the run ended; null while it goes on. */
  readonly ended?: "complete" | "stopped" | null;
}

const HEIGHT_PX = 170;

interface Curve {
  readonly label: string;
  readonly colour: string;
  readonly value: (line: CurvePoint) => number | null | undefined;
  readonly scale?: string;
  readonly dashed?: boolean;
}

interface Chart {
  readonly title: string;
  readonly axis: string;
  readonly logarithmic?: boolean;
  readonly second?: string;
  readonly curves: readonly Curve[];
  readonly summary: (lines: readonly CurvePoint[]) => string;
  /** Whether a line belongs to this chart, and the note until its curve begins. */
  readonly of?: (line: CurvePoint) => boolean;
  readonly later?: string;
  /** What it measures and decides, where the title cannot say it. */
  readonly note?: string;
}

const CHARTS: readonly Chart[] = [
  {
    title: "Fit to the photos",
    axis: "PSNR (dB)",
    second: "loss",
    curves: [
      { label: "PSNR, dB", colour: "--curve-1", value: (line) => line.psnr },
      { label: "loss", colour: "--curve-2", value: (line) => line.loss, scale: "second", dashed: true },
    ],
    summary: (lines) => ends(lines, "PSNR of the training views", (line) => `${fixed(line.psnr, 1)} dB`),
  },
  {
    title: "Motion of the cameras between checks",
    axis: "degrees",
    logarithmic: true,
    curves: [
      { label: "rotation, ° (90 % quantile)", colour: "--curve-1", value: (line) => positive(line.moved_deg) },
    ],
    summary: (lines) => ends(lines, "Turning between checks", (line) => `${short(line.moved_deg)} degrees`),
  },
  {
    title: "What stage 1 still gains",
    axis: "dB",
    of: (line) => line.stage === "coarse",
    later: "begins at the sixth check",
    note:
      "How much better the photos fit than halfway through the steps so far. Stage 2 begins once this stays between the dashed " +
      "lines, or after the longest stage 1 allowed.",
    curves: [
      { label: "gain, dB", colour: "--curve-1", value: (line) => line.trend_db },
      { label: "little against all that was gained, ± dB", colour: "--curve-3", value: (line) => line.level_db, dashed: true },
      { label: "", colour: "--curve-3", value: (line) => negative(line.level_db), dashed: true },
    ],
    summary: (lines) =>
      ends(
        lines.filter((line) => line.trend_db != null),
        "Gain over the later half of the steps, in stage 1",
        (line) => `${fixed(line.trend_db, 2)} dB`,
      ),
  },
];

const positive = (value: number): number | undefined => (value > 0 ? value : undefined); // zero has no place on a logarithmic axis
const negative = (value: number | null | undefined) => (value == null ? value : -value);

function ends(lines: readonly CurvePoint[], what: string, say: (line: CurvePoint) => string): string {
  const [first, last] = [lines[0], lines[lines.length - 1]];
  if (!first || !last) return `${what}: nothing yet`;
  return `${what}: ${say(first)} at step ${first.step}, ${say(last)} at step ${last.step}`;
}

export function Curves({ lines, switchStep = null, switchReason = null, steps = null, ended = null }: CurvesProps) {
  if (lines.length === 0) {
    return (
      <section class="curves" aria-label="Curves of the run">
        <p class="notice">The curves begin at the run's first check of its progress.</p>
      </section>
    );
  }
  const shown = CHARTS.filter((chart) => !chart.of || lines.some(chart.of));
  const began = switchStep ?? switchOf(lines);
  return (
    <section class="curves" aria-label="Curves of the run">
      <div class="curves-charts">
        {shown.map((chart) => (
          <Plot key={chart.title} chart={chart} lines={lines} switchStep={began} steps={steps} over={ended !== null} />
        ))}
      </div>
      <p class="curves-stages soft">
        <i class="stage-1" /> stage 1, low resolution: poses{" "}
        {began !== null && began > 0 ? (
          <>
            <i class="stage-2" /> stage 2, high resolution: detail, from step {began}
            {switchReason === "stable" && " (the fit had settled)"}
            {switchReason === "cap" && " (at the step limit)"}
          </>
        ) : (
          NO_STAGE_2[ended ?? "running"]
        )}
      </p>
    </section>
  );
}

const NO_STAGE_2 = {
  running: "(stage 2 has not begun)",
  stopped: "(the run was stopped before stage 2)",
  complete: "(the run had no stage 2)",
} as const;

/** The last step of stage 1, once stage 2 has begun. */
function switchOf(lines: readonly CurvePoint[]): number | null {
  const first = lines.findIndex((line) => line.stage === "fine");
  return first < 0 ? null : first === 0 ? 0 : (lines[first - 1]?.step ?? null);
}

function Plot(props: { chart: Chart; lines: readonly CurvePoint[]; switchStep: number | null; steps: number | null; over: boolean }) {
  const { chart, lines, switchStep, steps, over } = props;
  const dark = useDark();
  const host = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const data = useMemo<uPlot.AlignedData>(
    () => [lines.map((line) => line.step), ...chart.curves.map((curve) => lines.map((line) => curve.value(line) ?? null))],
    [chart, lines],
  );
  const latest = useRef({ data, switchStep, steps });
  latest.current = { data, switchStep, steps };

  useEffect(() => {
    const element = host.current;
    if (!element) return;
    const { plot: made, close } = chartIn(element, optionsOf(chart, latest), latest.current.data);
    plot.current = made;
    return () => {
      close();
      plot.current = null;
    };
  }, [chart, dark]);

  useEffect(() => plot.current?.setData(data), [data, switchStep, steps]);

  return (
    <figure class="curve">
      <figcaption>
        <b>{chart.title}</b>
        {chart.curves
          .filter((curve) => curve.label)
          .map((curve) => (
            <span key={curve.label} class="soft">
              <i class={curve.dashed ? "dash dash-dashed" : "dash"} style={{ color: `var(${curve.colour})` }} /> {curve.label}
            </span>
          ))}
        {chart.later && !lines.some((line) => line.trend_db != null) && <span class="soft">({over ? "stage 1 ended before that was known" : chart.later})</span>}
      </figcaption>
      <div ref={host} role="img" aria-label={`${chart.title}. ${chart.summary(lines)}.`} />
      {chart.note && <p class="curve-note soft">{chart.note}</p>}
    </figure>
  );
}

function optionsOf(
  chart: Chart,
  latest: { readonly current: { switchStep: number | null; steps: number | null } },
): Omit<uPlot.Options, "width"> {
  return {
    height: HEIGHT_PX,
    legend: { show: false },
    cursor: { sync: { key: "biresnerf-curves" }, drag: { x: false, y: false }, points: { size: 6 } },
    scales: {
      x: { time: false, range: (_, low, high) => [Math.min(0, low), Math.max(latest.current.steps ?? 0, high)] },
      y: chart.logarithmic ? { distr: 3 } : {},
      second: { distr: 3 },
    },
    axes: [
      chartAxis({ size: 26 }),
      chartAxis({ label: chart.axis, size: 46 }),
      ...(chart.second ? [chartAxis({ scale: "second", side: 1, label: chart.second, size: 52, grid: { show: false } })] : []),
    ],
    series: [
      {},
      ...chart.curves.map((curve): uPlot.Series => ({
        label: curve.label,
        stroke: themeColour(curve.colour),
        width: curve.dashed ? 1.25 : 1.75,
        dash: curve.dashed ? [5, 4] : undefined,
        scale: curve.scale ?? "y",
        points: { show: false },
        spanGaps: false,
      })),
    ],
    hooks: { drawClear: [(plot) => drawStages(plot, latest.current.switchStep)] },
  };
}

/** Draws the two stages as bands behind the curves. */
function drawStages(plot: uPlot, switchStep: number | null): void {
  const { ctx, bbox } = plot;
  const at = (step: number) => Math.min(bbox.left + bbox.width, Math.max(bbox.left, plot.valToPos(step, "x", true)));
  const middle = switchStep === null ? bbox.left + bbox.width : at(switchStep);
  ctx.save();
  ctx.fillStyle = themeColour("--stage-1");
  ctx.fillRect(bbox.left, bbox.top, middle - bbox.left, bbox.height);
  ctx.fillStyle = themeColour("--stage-2");
  ctx.fillRect(middle, bbox.top, bbox.left + bbox.width - middle, bbox.height);
  ctx.restore();
}
