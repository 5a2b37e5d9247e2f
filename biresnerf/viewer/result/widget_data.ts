// From the files of a result to what widgets take.
import { useMemo } from "preact/hooks";
import { bordersOf, centreOf, length, minus, turnDeg } from "./poses";
import type {
  HistoryLine,
  ImageRow,
  PointLayer,
  PointsEntry,
  PosesFile,
  ReportFile,
  SceneCamera,
  SheetCell,
  UrlOf,
  ViewFile,
} from "./types";

/** Cameras before and after; what the report measured of them joins by index, as both files keep the input's order. */
export function camerasOf(poses: PosesFile, report: ReportFile | null): SceneCamera[] {
  const borders = poses.cameras.map(bordersOf);
  return poses.images.map((image, index) => {
    const before = image.world_from_cam_before;
    const after = image.world_from_cam;
    const told = report?.images[index];
    const measured = told?.trial_psnr_after != null && told.trial_psnr_before != null;
    return {
      name: image.name,
      before,
      after,
      borders: borders[image.camera] ?? [-0.5, -0.5, 0.5, 0.5],
      source: image.pose_source,
      moved_deg: before ? turnDeg(before, after) : (told?.moved_deg ?? 0),
      moved_units: before ? length(minus(centreOf(after), centreOf(before))) : (told?.moved_units ?? 0),
      delta_psnr: measured ? (told.trial_psnr_after ?? 0) - (told.trial_psnr_before ?? 0) : null,
      flags: image.flags,
    };
  });
}

export function rowsOf(report: ReportFile): ImageRow[] {
  const flags = ["held_out", "fixed", "lost", "repaired", "moved_far", "blurred", "exposure_off", "unsure_deg"] as const;
  return report.images.map((image, index) => ({
    image: index,
    name: image.name,
    source: image.pose_source,
    moved_deg: image.moved_deg,
    moved_units: image.moved_units,
    psnr_before: image.trial_psnr_before,
    psnr_after: image.trial_psnr_after,
    epipolar_px_before: image.epipolar_px_before,
    epipolar_px_after: image.epipolar_px_after,
    psnr: image.psnr,
    flags: flags.filter((flag) => image[flag]),
  }));
}

/** Lines of history.jsonl; one that is torn off, or none at all, is left out. */
export function historyOf(text: string): HistoryLine[] {
  const lines: HistoryLine[] = [];
  for (const line of text.split("\n")) {
    try {
      const read: unknown = JSON.parse(line);
      if (typeof read === "object" && read !== null && "step" in read) lines.push(read as HistoryLine);
    } catch {
      // The last line of a run that is being written.
    }
  }
  return lines;
}

/** Points from the bytes of a file that view.json lists. */
export function pointsOf(entry: PointsEntry, bytes: ArrayBuffer): PointLayer {
  const positions = new Float32Array(entry.count * 3);
  const view = new DataView(bytes);
  for (let i = 0; i < positions.length; i++) positions[i] = view.getFloat32(4 * i, true);
  const colours = new Uint8Array(bytes.slice(12 * entry.count, 15 * entry.count));
  return { source: entry.source, positions, colours, origin: entry.origin };
}

/** Where each image's photo lies in the contact sheet. */
export function cellsOf(view: ViewFile | null, images: number, urlOf: UrlOf): (image: number) => SheetCell | null {
  const sheet = view?.contact_sheet;
  const url = sheet ? urlOf(sheet.file) : null;
  if (!sheet || !url) return () => null;
  const rows = Math.ceil(images / sheet.columns);
  return (image) => ({
    url,
    x: (image % sheet.columns) * sheet.cell_width,
    y: Math.floor(image / sheet.columns) * sheet.cell_height,
    width: sheet.cell_width,
    height: sheet.cell_height,
    sheet_width: sheet.columns * sheet.cell_width,
    sheet_height: rows * sheet.cell_height,
  });
}

/** What the widgets of one result share; worked out again where its files change. */
export function useWidgetData(poses: PosesFile | null, report: ReportFile | null, view: ViewFile | null, urlOf: UrlOf) {
  const names = useMemo(() => poses?.images.map(({ name }) => name) ?? [], [poses]);
  const cameras = useMemo(() => (poses ? camerasOf(poses, report) : []), [poses, report]);
  const centres = useMemo(() => cameras.map(({ after }) => centreOf(after)), [cameras]);
  const rows = useMemo(() => (report ? rowsOf(report) : []), [report]);
  const cellOf = useMemo(() => cellsOf(view, names.length, urlOf), [view, names, urlOf]);
  return { names, cameras, centres, rows, cellOf };
}
