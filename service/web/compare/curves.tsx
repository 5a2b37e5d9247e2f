// The curves of two runs in one chart.
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import { chartAxis, chartIn } from "../../../biresnerf/viewer/widgets/chart";
import { fixed } from "../../../biresnerf/viewer/widgets/numbers";
import { themeColour, useDark } from "../../../biresnerf/viewer/widgets/theme";
import { titleOf } from "../jobs/state";
import type { Side } from "./page";

const HEIGHT_PX = 260;
const COLOURS = ["--curve-1", "--curve-2"] as const;

export function OverlaidCurves({ sides }: { sides: readonly [Side, Side] }) {
  const dark = useDark();
  const host = useRef<HTMLDivElement>(null);
  useEffect(() => {
    const element = host.current;
    if (!element) return;
    const tables = sides.map(({ history }): uPlot.AlignedData => [history.map(({ step }) => step), history.map(({ psnr }) => psnr)]);
    return chartIn(
      element,
      {
        height: HEIGHT_PX,
        legend: { show: false },
        scales: { x: { time: false } },
        axes: [chartAxis({ label: "step", size: 26 }), chartAxis({ label: "PSNR (dB)", size: 46 })],
        series: [
          {},
          ...sides.map(({ job }, index): uPlot.Series => ({
            ...{ label: titleOf(job), stroke: themeColour(COLOURS[index] ?? COLOURS[0]), width: 1.75 },
            ...{ points: { show: false }, spanGaps: true },
          })),
        ],
      },
      uPlot.join(tables),
    ).close;
  }, [sides, dark]);
  const ends = sides.map(({ job, history }) => `${titleOf(job)}: ${fixed(history.at(-1)?.psnr ?? null, 1)} dB at step ${history.at(-1)?.step ?? 0}`);
  return <div ref={host} class="overlaid" role="img" aria-label={`PSNR of the training views. ${ends.join(". ")}.`} />;
}
