// The state of one job and its files, kept up to date while its page is open.
import type { ArtifactList, ArtifactView, JobView, PosesDocument, Report, SeedingPreview, ViewFile } from "schemas";
import { type CurvePoint, historyOf, type PointLayer, pointsOf } from "../../../biresnerf/viewer/result/widget_data";
import { followJob, type JobEvent } from "../api/events";
import { asProblem, pause, type Problem, request, requestJson, shared } from "../api/http";
import { Store } from "../api/store";
import { isOver } from "../jobs/state";
import { notifyOfEnds } from "../parts/notify";

export interface LiveState {
  job: JobView | null;
  events: JobEvent[];
  artifacts: readonly ArtifactView[];
  /** The curves so far. */
  history: CurvePoint[];
  poses: PosesDocument | null;
  report: Report | null;
  view: ViewFile | null;
  points: PointLayer[];
  /** Feature matches, while COLMAP runs. */
  seeding: SeedingPreview | null;
  /** Whether events arrive. */
  connected: boolean;
  problem: Problem | null;
}

const NOTHING: LiveState = {
  ...{ job: null, events: [], artifacts: [], history: [], poses: null, report: null, view: null, points: [] },
  ...{ seeding: null, connected: true, problem: null },
};

export class LiveJob extends Store<LiveState> {
  private readonly stop = new AbortController();
  /** The digest of each file when it was last read; a preview with another digest is read again. */
  private readonly digests = new Map<string, string>();
  private recorded: CurvePoint[] = [];
  /** From progress events since the last preview. */
  private live: CurvePoint[] = [];
  private loading: Promise<void> | null = null;
  private loadAgain = false;
  /** Whether the job was over before its files were loaded: there will be no others. */
  private complete = false;

  constructor(readonly id: string) {
    super(NOTHING);
  }

  close(): void {
    this.stop.abort();
  }

  /** Loads new files: a preview, the result, an export. */
  refresh(): Promise<void> {
    if (this.loading) {
      this.loadAgain = true;
      return this.loading;
    }
    this.loading = this.load().finally(() => {
      this.loading = null;
      if (this.loadAgain && !this.stop.signal.aborted) {
        this.loadAgain = false;
        void this.refresh();
      }
    });
    return this.loading;
  }

  /** Keeps the state up to date until the job is over or the page is left. */
  async run(): Promise<void> {
    try {
      await this.waitForJob();
      const over = this.value.job !== null && isOver(this.value.job);
      await this.refresh();
      this.complete = over && this.value.artifacts.length > 0;
      if (shared.value) return; // links open what a job has, not what happens to it
      const handlers = { onProgress: this.progress, onEvent: this.event, onConnection: this.connection };
      await followJob(this.id, handlers, this.stop.signal);
    } catch (error) {
      if (!this.stop.signal.aborted) this.change({ problem: asProblem(error) });
    }
  }

  /** Asks for the job until the service responds. */
  private async waitForJob(): Promise<void> {
    for (;;) {
      try {
        this.change({ job: await requestJson<JobView>("GET", `v1/jobs/${this.id}`), problem: null });
        return;
      } catch (error) {
        const problem = asProblem(error);
        this.change({ problem });
        if (!problem.transient) throw error;
        await pause(2000);
        if (this.stop.signal.aborted) throw error;
      }
    }
  }

  private readonly connection = (connected: boolean) => this.change({ connected });

  private readonly progress = (job: JobView) => {
    // An attempt that resumes from a checkpoint repeats steps of the one before.
    if (stepping(job)) this.live = this.live.filter((line) => line.step <= job.progress.step);
    const last = this.live.at(-1) ?? this.recorded.at(-1);
    const line = lineOf(job, last);
    if (line) this.live.push(line);
    const ended = isOver(job) && this.value.job !== null && !isOver(this.value.job);
    if (this.value.job) notifyOfEnds([this.value.job], [job]);
    this.change({ job, history: [...this.recorded, ...this.live] });
    if (ended) void this.refresh();
  };

  private readonly event = (event: JobEvent) => {
    this.change({ events: [...this.value.events, event] });
    // Old events are replayed on connecting; the files were loaded once already.
    const fresh = !this.complete && Date.now() - Date.parse(event.at) < 60_000;
    if (fresh && ["preview", "succeeded", "cancelled", "failed", "expired"].includes(event.type)) void this.refresh();
  };

  private async load(): Promise<void> {
    try {
      const { items } = await requestJson<ArtifactList>("GET", `v1/jobs/${this.id}/artifacts`, { signal: this.stop.signal });
      this.change({ artifacts: items });
      await this.readFiles();
    } catch (error) {
      const problem = asProblem(error);
      if (!this.stop.signal.aborted && problem.code !== "expired" && !problem.transient) this.change({ problem });
    }
  }

  private async readFiles(): Promise<void> {
    const view = (await this.json<ViewFile>("view.json")) ?? this.value.view;
    const [history, report, poses, seeding] = await Promise.all([
      this.text("history.jsonl"),
      this.json<Report>("report.json"),
      this.json<PosesDocument>(view?.poses ?? "poses.json"),
      this.json<SeedingPreview>("seeding.json"),
    ]);
    if (history !== null) {
      this.recorded = historyOf(history);
      const end = this.recorded.at(-1)?.step ?? 0;
      this.live = this.live.filter((line) => line.step > end);
    }
    this.change({
      view,
      history: [...this.recorded, ...this.live],
      report: report ?? this.value.report,
      poses: poses ?? this.value.poses,
      seeding: seeding ?? this.value.seeding,
    });
    if (view && !this.value.points.length) this.change({ points: await this.points(view) });
  }

  private async points(view: ViewFile): Promise<PointLayer[]> {
    const layers = view.points.map(async (entry) => {
      const response = await this.file(entry.file);
      return response && entry.count > 0 ? pointsOf(entry, await response.arrayBuffer()) : null;
    });
    return (await Promise.all(layers)).filter((layer) => layer !== null);
  }

  /** The file's text if it has changed since it was last read; the preview's while the job runs. */
  private async text(name: string): Promise<string | null> {
    return (await (await this.file(name))?.text()) ?? null;
  }

  private async json<T>(name: string): Promise<T | null> {
    const text = await this.text(name);
    return text === null ? null : (JSON.parse(text) as T);
  }

  private async file(name: string): Promise<Response | null> {
    const found = [name, `preview/${name}`].flatMap((n) => this.value.artifacts.filter((a) => a.name === n))[0];
    if (!found || this.digests.get(name) === found.sha256) return null;
    try {
      const response = await request("GET", `${found.href}?redirect=false`, { signal: this.stop.signal });
      this.digests.set(name, found.sha256);
      return response;
    } catch (error) {
      if (asProblem(error).status === 404) return null; // replaced by the next preview
      throw error;
    }
  }
}

const SIGNAL = ["trend_db", "level_db"] as const;

const stepping = ({ stage }: JobView) => (stage === "coarse" || stage === "fine" ? stage : null);

/** A point of the curves from a progress event, if its step is later than the last one. */
function lineOf(job: JobView, last: CurvePoint | undefined): CurvePoint | null {
  const { loss, psnr, moved_deg } = job.metrics;
  const { step } = job.progress;
  const stage = stepping(job);
  if (!stage || loss === undefined || psnr === undefined || !last || step <= last.step) return null;
  const line = { step, stage, loss, psnr, moved_deg: moved_deg ?? 0 };
  // What decides when stage 2 begins is known in stage 1 only; the job keeps its last values.
  const signal = stage === "coarse" ? SIGNAL.filter((name) => job.metrics[name] !== undefined) : [];
  return { ...line, ...Object.fromEntries(signal.map((name) => [name, job.metrics[name]])) };
}
