// What the widgets shared by the service's page and report.html take, and the files that it is made from.
//
// The files are written by the library and documented in docs/formats.md; `job_data.ts` turns them into props:
//   camerasOf(poses, report), centresOf(poses), rowsOf(report), historyOf(text), pointsOf(entry, bytes),
//   cellsOf(view, images, urlOf).
// A widget fetches nothing: pictures are URLs that a callback gives for a file of the result, points are bytes.

// ---------------------------------------------------------------- files

export type Triple = readonly [number, number, number];
export type Row = readonly [number, number, number, number];
/** Upper three rows of a 4 x 4 matrix; OpenCV axes (x right, y down, z forward), in the input's world. */
export type Matrix = readonly [Row, Row, Row];

/** poses.json, and preview/poses.json while a job runs; keys that nobody shows are left out. */
export interface PosesFile {
  readonly cameras: readonly { model: string; width: number; height: number; params: readonly number[] }[];
  readonly images: readonly {
    name: string;
    file_name: string;
    camera: number;
    world_from_cam: Matrix;
    world_from_cam_before: Matrix | null;
    pose_source: string;
    flags: readonly string[];
  }[];
}

export type VerdictName = "improved" | "unchanged" | "kept_input" | "inconclusive" | "failed_check";

export interface PairedDifference {
  readonly count: number;
  readonly before: number;
  readonly after: number;
  readonly difference: number;
  readonly low: number | null;
  readonly high: number | null;
  readonly finding: "better" | "worse" | "same" | "open";
}

export interface Verdict {
  readonly verdict: VerdictName;
  readonly returned: "refined" | "input";
  readonly compared_with: "given" | "seeded" | "mixed";
  readonly why: readonly string[];
  readonly moved_px: number;
  readonly heldout: { steps: number; strictly: number; psnr: PairedDifference; ssim: PairedDifference } | null;
  readonly epipolar: {
    matches: number;
    independent: boolean;
    error_px: PairedDifference;
    share_of_image: number;
  } | null;
}

export interface ImageReport {
  readonly name: string;
  readonly pose_source: string;
  readonly held_out: boolean;
  readonly fixed: boolean;
  readonly moved_deg: number;
  readonly moved_units: number;
  readonly lost: boolean;
  readonly repaired: boolean;
  readonly moved_far: boolean;
  readonly blurred: boolean;
  readonly exposure_off: boolean;
  readonly unsure_deg: number | null;
  readonly trial_psnr_before: number | null;
  readonly trial_psnr_after: number | null;
  readonly epipolar_px_before: number | null;
  readonly epipolar_px_after: number | null;
  readonly psnr: number | null;
  readonly ssim: number | null;
}

/** report.json, and preview/report.json while a job runs; keys that nobody shows are left out. */
export interface ReportFile {
  readonly version: string;
  readonly state: "complete" | "partial";
  readonly options: Readonly<Record<string, unknown>>;
  readonly verdict: Verdict | null;
  readonly images: readonly ImageReport[];
  readonly heldout: { count: number; psnr: number; ssim: number } | null;
  readonly steps_done: number;
  readonly switch_step: number | null;
  readonly switch_reason: "stable" | "cap" | null;
  readonly seconds: Readonly<Record<string, number>>;
  readonly device: string;
  readonly working_size: readonly [number, number];
  readonly warnings: readonly string[];
}

/** A line of history.jsonl; preview/history.jsonl has the lines so far while a job runs. */
export interface HistoryLine {
  readonly step: number;
  readonly stage: "coarse" | "fine";
  readonly psnr: number;
  readonly loss: number;
  /** 90 % quantile of how far the cameras turned since the line before, degrees. */
  readonly moved_deg: number;
  readonly pose_rate: number;
  readonly seconds: number;
  /** The stability detector's view, stage 1 only: turning below which cameras count as settled (deg). */
  readonly still_deg?: number;
  /** Net change of the error over the detector's window, dB, and what of it counts as level; from its 10th line on. */
  readonly trend_db?: number;
  readonly level_db?: number;
  /** Checks in a row that found the error stable. */
  readonly confirmed?: number;
}

export type PictureKind = "render" | "photo" | "difference" | "depth";

/** A view that was rendered at the end. */
export interface RenderedView {
  /** Index of the image. */
  readonly image: number;
  /** Whether the field never learnt from its photo. */
  readonly held_out: boolean;
  readonly width: number;
  readonly height: number;
  /** Render against photo at this size, dB. */
  readonly psnr: number;
  /** Files of the result, e.g. `renders/train_r_3_render.png`. */
  readonly pictures: Readonly<Partial<Record<PictureKind, string>>>;
}

/** Sparse points; `file` holds float32 [count, 3] positions (little-endian, relative to `origin`), then uint8 [count, 3] colours. */
export interface PointsEntry {
  /** As `points_source` of poses.json, or `field`: where the rendered views' rays end in the radiance field. */
  readonly source: "given" | "features" | "tracks" | "moved" | "field";
  readonly file: string;
  readonly count: number;
  readonly origin: Triple;
}

/** view.json: what of a result is there to be looked at. */
export interface ViewFile {
  readonly format: "biresnerf-view";
  readonly version: 1;
  /** The poses that were refined, whatever the verdict: `poses.json`, or `refined/poses.json` where the result holds the input's. */
  readonly poses: string;
  /** One picture for the whole job, `thumbnail.jpg`. */
  readonly thumbnail: string;
  /** All photos, small, in one picture: image i lies in row floor(i / columns). Null where there are too many. */
  readonly contact_sheet: { file: string; columns: number; cell_width: number; cell_height: number } | null;
  readonly views: readonly RenderedView[];
  readonly points: readonly PointsEntry[];
  /** The orbit video, where there is one. */
  readonly orbit: string | null;
}

// ---------------------------------------------------------------- widgets

/** URL of a file of the result (`renders/…`, `view/…`), or null where it cannot be had (left out, not there yet). */
export type UrlOf = (file: string) => string | null;

export interface SceneCamera {
  readonly name: string;
  readonly before: Matrix | null;
  readonly after: Matrix;
  /** The picture's borders at distance 1 before the lens: left, top, right, bottom. */
  readonly borders: readonly [number, number, number, number];
  /** Whose pose it started from: `given`, `colmap`, `neighbours`, … */
  readonly source: string;
  readonly moved_deg: number;
  readonly moved_units: number;
  /** Refined minus input in the verdict's trainings, dB, where measured. */
  readonly delta_psnr: number | null;
  readonly flags: readonly string[];
}

export interface PointLayer {
  readonly source: PointsEntry["source"];
  /** Positions in the world minus `origin`, [3 n]. */
  readonly positions: Float32Array;
  /** [3 n]. */
  readonly colours: Uint8Array;
  readonly origin: Triple;
}

export type ColourBy = "moved_deg" | "moved_units" | "delta_psnr" | "source";

/** (1) Cameras before and after in three dimensions. A table takes its place where WebGL is missing. */
export interface SceneViewProps {
  readonly cameras: readonly SceneCamera[];
  readonly points?: readonly PointLayer[];
  /** Index of the chosen image; null: none. */
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
}

/** (2) Render against photo at the chosen camera. */
export interface ImageCompareProps {
  readonly names: readonly string[];
  readonly views: readonly RenderedView[];
  /** Centres of the cameras, to say which views are near one that has none. */
  readonly centres: readonly Triple[];
  readonly urlOf: UrlOf;
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
}

/** (3) Curves of the run; lines may grow from one rendering to the next. */
export interface CurvesProps {
  readonly lines: readonly HistoryLine[];
  /** First step of stage 2, once known. */
  readonly switchStep?: number | null;
  readonly switchReason?: "stable" | "cap" | null;
  /** All steps of the run, where known: the axis then shows what is still to come. */
  readonly steps?: number | null;
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
  readonly flags: readonly string[];
}

/** Where an image's picture lies in the contact sheet. */
export interface SheetCell {
  readonly url: string;
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
  /** Size of the whole sheet, for those who show it smaller. */
  readonly sheet_width: number;
  readonly sheet_height: number;
}

/** (4) One row an image: sorted by a click on a heading, filtered by name and flag. */
export interface ImageTableProps {
  readonly rows: readonly ImageRow[];
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
  /** The image's place in the contact sheet. */
  readonly cellOf?: (image: number) => SheetCell | null;
  /** Images that are ticked, where they can be. */
  readonly ticked?: ReadonlySet<number>;
  readonly onTick?: (image: number, on: boolean) => void;
}

/** (5) The verdict in one sentence, with its proof. */
export interface VerdictSentenceProps {
  readonly verdict: Verdict | null;
  readonly state: "complete" | "partial";
  /** Whether a verdict was asked for. */
  readonly asked?: boolean;
}
