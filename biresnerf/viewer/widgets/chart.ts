// What all charts have in common: their axes, and how they keep to the width of their place.
import uPlot from "uplot";
import { themeColour } from "./theme";

const FONT = "11px system-ui, sans-serif";

/** An axis in the theme's colours. */
export function chartAxis(more: uPlot.Axis): uPlot.Axis {
  const line = { stroke: themeColour("--line"), width: 1 };
  return { stroke: themeColour("--text-soft"), font: FONT, labelFont: FONT, labelSize: 16, ticks: { ...line, size: 4 }, grid: line, ...more };
}

/** A chart in `place`, always as wide as that; `close` removes it. */
export function chartIn(
  place: HTMLElement,
  options: Omit<uPlot.Options, "width">,
  data: uPlot.AlignedData,
): { plot: uPlot; close: () => void } {
  const plot = new uPlot({ ...options, width: place.clientWidth }, data, place);
  const observer = new ResizeObserver(() => plot.setSize({ width: place.clientWidth, height: options.height }));
  observer.observe(place);
  const close = () => {
    observer.disconnect();
    plot.destroy();
  };
  return { plot, close };
}
