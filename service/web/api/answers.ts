// What the service answers, as far as the page reads it. Written by hand: it reads a fifth of the interface, and
// tests/web/test_answers.py holds every name here to docs/openapi.json.

export type JobState = "queued" | "running" | "succeeded" | "failed" | "cancelled" | "expired";
export type Stage = "preparing" | "seeding" | "coarse" | "fine" | "evaluating" | "exporting";
export const STAGES: readonly Stage[] = ["preparing", "seeding", "coarse", "fine", "evaluating", "exporting"];

export interface JobError {
  code: string;
  detail: string;
  where: string;
  hint: string;
  retryable: boolean;
  log_tail: string;
}

export interface JobProgress {
  fraction: number;
  step: number;
  steps_total: number;
  eta_s: number | null;
}

export interface JobView {
  id: string;
  kind: "refine" | "export";
  parent: string | null;
  forked_from: string | null;
  forked_stage: string | null;
  dataset_id: string;
  state: JobState;
  stage: Stage | null;
  progress: JobProgress;
  queue_position: number | null;
  attempt: number;
  cancel_requested: boolean;
  created_at: string;
  started_at: string | null;
  finished_at: string | null;
  expires_at: string | null;
  options: Record<string, unknown>;
  smaller: Record<string, unknown>;
  partial: boolean;
  metrics: Record<string, number>;
  message: string;
  verdict: "improved" | "unchanged" | "kept_input" | "inconclusive" | "failed_check" | null;
  error: JobError | null;
  thumbnail: string | null;
  labels: Record<string, string>;
  revision: number;
}

export interface JobList {
  items: JobView[];
  next_cursor: string | null;
}

export interface ArtifactView {
  name: string;
  size: number;
  sha256: string;
  media_type: string;
  preview: boolean;
  href: string;
}

export interface ArtifactList {
  items: ArtifactView[];
}

/** `report` of a dataset, written by workers/datasets/dataset_check_process.py; not in the interface's description. */
export interface CheckReport {
  images: number;
  with_pose: number;
  without_pose: number;
  cameras: number;
  camera_models: string[];
  intrinsics: string[];
  format: string;
  masks: number;
  transparency: boolean;
  warnings: string[];
}

export interface DatasetView {
  id: string;
  name: string;
  state: "open" | "finalizing" | "ready" | "rejected" | "expired";
  files: number;
  bytes: number;
  missing: string[];
  report: CheckReport | null;
  error: JobError | null;
  created_at: string;
  expires_at: string | null;
}

export interface UploadView {
  id: string;
  dataset_id: string;
  size: number;
  state: "receiving" | "received" | "stored" | "rejected";
  received: number;
  error: JobError | null;
}

export interface OptionsView {
  json_schema: Schema;
  presets: Record<string, Record<string, unknown>>;
}

/** The part of JSON Schema that pydantic uses for the options. */
export interface Schema {
  type?: string;
  description?: string;
  default?: unknown;
  enum?: (string | number)[];
  anyOf?: Schema[];
  items?: Schema;
  properties?: Record<string, Schema>;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
  exclusiveMaximum?: number;
}

export interface SizeLimits {
  max_files: number;
  max_file_bytes: number;
  max_dataset_bytes: number;
  max_archive_bytes: number;
}

export interface Info {
  version: string;
  limits: SizeLimits;
  job_counts: Partial<Record<JobState, number>>;
}

export interface ShareView {
  name: string;
  href: string;
  expires_at: string;
}
