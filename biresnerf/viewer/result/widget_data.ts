// Prepares the files of a result for the widgets, which fetch nothing themselves.
import { useMemo } from "preact/hooks";
import type { ContactSheet, HistoryLine, ImageReport, PosesDocument, Report, ShownPoints, ViewFile } from "schemas";
import { type Flag, FLAGS } from "../widgets/words";
import { bordersOf, centreOf, length, type Matrix, minus, type Triple, turnDeg } from "./poses";

/** URL of a file of the result (`renders/…`, `view/…`), or null if it is not there (yet). */
export type UrlOf = (file: string) => string | null;

/** The part of a history line that the curves show. */
export type CurvePoint = Pick<
  HistoryLine,
  "step" | "stage" | "psnr" | "loss" | "moved_deg" | "trend_db" | "level_db"
>;

export interface SceneCamera {
  readonly name: string;
  readonly before: Matrix | null;
  readonly after: Matrix;
  /** Borders of the image at distance 1 in front of the lens: left, top, right, bottom. */
  readonly borders: readonly [number, number, number, number];
  /** Source of its initial pose: `given`, `colmap`, `neighbours`, … */
  readonly source: string;
  readonly moved_deg: number;
  readonly moved_units: number;
  /** PSNR on refined poses minus on the input's, dB, in the verdict's trainings; null if not measured. */
  readonly delta_psnr: number | null;
  /** The part of a large set that its pose was taken from; null if there are no parts, or it is of none. */
  readonly part: string | null;
  /** By how much parts disagree on it; null if at most one has it. */
  readonly parts_apart_deg: number | null;
  readonly flags: readonly string[];
  /** What is said of the returned pose; null if nothing was. */
  readonly uncertainty: ImageReport["uncertainty"];
  /** The pose that the result holds: the input's, if the verdict kept it. */
  readonly returned: Matrix;
}

export interface PointLayer {
  readonly source: ShownPoints["source"];
  /** Positions in the world minus `origin`, [3 n]. */
  readonly positions: Float32Array;
  /** [3 n]. */
  readonly colours: Uint8Array;
  readonly origin: Triple;
}

export interface ImageRow {
  readonly image: number;
  readonly name: string;
  readonly source: string;
  readonly moved_deg: number;
  readonly moved_units: number;
  readonly psnr_before: number | null;
  readonly psnr_after: number | null;
  readonly epipolar_px_before: number | null;
  readonly epipolar_px_after: number | null;
  /** Held-out views: render against photo at the end. */
  readonly psnr: number | null;
  /** 90 % bounds of the returned pose's errors; null if not known. */
  readonly rotation_90: number | null;
  readonly position_90: number | null;
  readonly why_unknown: string | null;
  readonly flags: readonly Flag[];
}

/** How photos are laid out in one picture. */
type Sheet = Pick<ContactSheet, "columns" | "cell_width" | "cell_height">;

/** Where an image's picture lies in the contact sheet. */
export interface SheetCell {
  readonly url: string;
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
  /** Size of the whole sheet. */
  readonly sheet_width: number;
  readonly sheet_height: number;
}

/** Cameras before and after, joined by index with the report: both files keep the input's order. */
function camerasOf(poses: PosesDocument, report: Report | null): SceneCamera[] {
  const borders = poses.cameras.map(bordersOf);
  const joined = report?.parts;
  return poses.images.map((image, index) => {
    const before = image.world_from_cam_before;
    const after = image.world_from_cam;
    const measures = report?.images[index];
    const measured = measures?.trial_psnr_after != null && measures.trial_psnr_before != null;
    return {
      name: image.name,
      before,
      after,
      borders: borders[image.camera] ?? [-0.5, -0.5, 0.5, 0.5],
      source: image.pose_source,
      moved_deg: before ? turnDeg(before, after) : (measures?.moved_deg ?? 0),
      moved_units: before ? length(minus(centreOf(after), centreOf(before))) : (measures?.moved_units ?? 0),
      delta_psnr: measured ? (measures.trial_psnr_after ?? 0) - (measures.trial_psnr_before ?? 0) : null,
      part: joined?.parts[joined.part_of?.[index] ?? -1]?.name ?? null,
      parts_apart_deg: joined?.apart_deg?.[index] ?? null,
      flags: image.flags,
      uncertainty: measures?.uncertainty ?? null,
      returned: (report?.verdict ?? report?.verdict_so_far)?.returned === "input" && before ? before : after,
    };
  });
}

function rowsOf(report: Report): ImageRow[] {
  const flags = Object.keys(FLAGS) as Flag[];
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
    rotation_90: image.uncertainty?.rotation_deg ?? null,
    position_90: image.uncertainty?.position ?? null,
    why_unknown: image.uncertainty?.why_unknown ?? null,
    flags: flags.filter((flag) => (flag === "uncertainty" ? image.uncertainty?.why_unknown : image[flag])),
  }));
}

/** The lines of history.jsonl, without an incomplete last one. */
export function historyOf(text: string): CurvePoint[] {
  const lines: CurvePoint[] = [];
  for (const line of text.split("\n")) {
    try {
      const read: unknown = JSON.parse(line);
      if (typeof read === "object" && read !== null && "step" in read) lines.push(read as HistoryLine);
    } catch {
      // The last line while it is being written.
    }
  }
  return lines;
}

/** Points from the bytes of a file listed in view.json. */
export function pointsOf(entry: ShownPoints, bytes: ArrayBuffer): PointLayer {
  const positions = new Float32Array(entry.count * 3);
  const view = new DataView(bytes);
  for (let i = 0; i < positions.length; i++) positions[i] = view.getFloat32(4 * i, true);
  const colours = new Uint8Array(bytes.slice(12 * entry.count, 15 * entry.count));
  return { source: entry.source, positions, colours, origin: entry.origin };
}

/** Where each image's photo lies in the contact sheet. */
function cellsOf(view: ViewFile | null, images: number, urlOf: UrlOf): (image: number) => SheetCell | null {
  const sheet = view?.contact_sheet;
  const url = sheet ? urlOf(sheet.file) : null;
  if (!sheet || !url) return () => null;
  return cellsIn(sheet, url, images);
}

/** Where each of so many photos lies in the picture at `url`. */
export function cellsIn(sheet: Sheet, url: string, images: number): (image: number) => SheetCell {
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

/** The data that the widgets of one result share. */
export function useWidgetData(poses: PosesDocument | null, report: Report | null, view: ViewFile | null, urlOf: UrlOf) {
  const names = useMemo(() => poses?.images.map(({ name }) => name) ?? [], [poses]);
  const cameras = useMemo(() => (poses ? camerasOf(poses, report) : []), [poses, report]);
  const centres = useMemo(() => cameras.map(({ after }) => centreOf(after)), [cameras]);
  const rows = useMemo(() => (report ? rowsOf(report) : []), [report]);
  const cellOf = useMemo(() => cellsOf(view, names.length, urlOf), [view, names, urlOf]);
  const photoOf = useMemo(() => {
    const rendered = new Map(view?.views.map(({ image, pictures }) => [image, pictures.photo]));
    return (image: number) => {
      const file = rendered.get(image);
      return file === undefined ? null : urlOf(file);
    };
  }, [view, urlOf]);
  return { names, cameras, centres, rows, cellOf, photoOf };
}
