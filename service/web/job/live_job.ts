// All that is known of one job, kept up to date for as long as somebody looks.
import type { ArtifactList, ArtifactView, JobView, PosesDocument, Report, SeedingPreview, ViewFile } from "schemas";
import { type CurvePoint, historyOf, type PointLayer, pointsOf } from "../../../biresnerf/viewer/result/widget_data";
import { follow, type JobEvent } from "../api/events";
import { ask, asProblem, call, pause, type Problem } from "../api/http";
import { Store } from "../api/store";
import { isOver } from "../jobs/state";

export interface Seen {
  job: JobView | null;
  events: JobEvent[];
  artifacts: readonly ArtifactView[];
  /** The run's curve so far. */
  history: CurvePoint[];
  poses: PosesDocument | null;
  report: Report | null;
  view: ViewFile | null;
  points: PointLayer[];
  /** What COLMAP has found, while it works. */
  seeding: SeedingPreview | null;
  /** Whether progress comes as it happens. */
  linked: boolean;
  problem: Problem | null;
}

const NOTHING: Seen = {
  ...{ job: null, events: [], artifacts: [], history: [], poses: null, report: null, view: null, points: [] },
  ...{ seeding: null, linked: true, problem: null },
};

export class LiveJob extends Store<Seen> {
  private readonly stop = new AbortController();
  /** What was read of each file, by its digest: a preview of another digest is read anew. */
  private readonly read = new Map<string, string>();
  private recorded: CurvePoint[] = [];
  /** Between two previews the progress events tell how it goes. */
  private told: CurvePoint[] = [];
  private looking: Promise<void> | null = null;
  private lookAgain = false;

  constructor(readonly id: string) {
    super(NOTHING);
  }

  start(): void {
    void this.run();
  }

  close(): void {
    this.stop.abort();
  }

  /** Looks for new files: a preview, the result, an export. */
  refresh(): Promise<void> {
    if (this.looking) {
      this.lookAgain = true;
      return this.looking;
    }
    this.looking = this.look().finally(() => {
      this.looking = null;
      if (this.lookAgain && !this.stop.signal.aborted) {
        this.lookAgain = false;
        void this.refresh();
      }
    });
    return this.looking;
  }

  private async run(): Promise<void> {
    try {
      await this.reach();
      await this.refresh();
      const takers = { onProgress: this.progress, onEvent: this.event, onLink: this.link };
      await follow(this.id, takers, this.stop.signal);
    } catch (error) {
      if (!this.stop.signal.aborted) this.change({ problem: asProblem(error) });
    }
  }

  /** The job, once the service answers. */
  private async reach(): Promise<void> {
    for (;;) {
      try {
        this.change({ job: await call<JobView>("GET", `v1/jobs/${this.id}`), problem: null });
        return;
      } catch (error) {
        const problem = asProblem(error);
        this.change({ problem });
        if (!problem.passing) throw error;
        await pause(2000);
        if (this.stop.signal.aborted) throw error;
      }
    }
  }

  private readonly link = (linked: boolean) => this.change({ linked });

  private readonly progress = (job: JobView) => {
    // An attempt that begins at a checkpoint takes back what the one before told.
    if (stepping(job)) this.told = this.told.filter((line) => line.step <= job.progress.step);
    const last = this.told.at(-1) ?? this.recorded.at(-1);
    const line = lineOf(job, last);
    if (line) this.told.push(line);
    const ended = isOver(job) && this.value.job !== null && !isOver(this.value.job);
    this.change({ job, history: [...this.recorded, ...this.told] });
    if (ended) void this.refresh();
  };

  private readonly event = (event: JobEvent) => {
    this.change({ events: [...this.value.events, event] });
    // Where the story is replayed, one look at its end does.
    const fresh = Date.now() - Date.parse(event.at) < 60_000;
    if (fresh && ["preview", "succeeded", "cancelled", "failed"].includes(event.type)) void this.refresh();
  };

  private async look(): Promise<void> {
    try {
      const { items } = await call<ArtifactList>("GET", `v1/jobs/${this.id}/artifacts`, { signal: this.stop.signal });
      this.change({ artifacts: items });
      await this.readFiles();
    } catch (error) {
      const problem = asProblem(error);
      if (!this.stop.signal.aborted && problem.code !== "expired" && !problem.passing) this.change({ problem });
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
      this.told = this.told.filter((line) => line.step > end);
    }
    this.change({
      view,
      history: [...this.recorded, ...this.told],
      report: report ?? this.value.report,
      poses: poses ?? this.value.poses,
      seeding: seeding ?? this.value.seeding,
    });
    if (view && !this.value.points.length) this.change({ points: await this.points(view) });
  }

  private async points(view: ViewFile): Promise<PointLayer[]> {
    const layers = view.points.map(async (entry) => {
      const answer = await this.file(entry.file);
      return answer && entry.count > 0 ? pointsOf(entry, await answer.arrayBuffer()) : null;
    });
    return (await Promise.all(layers)).filter((layer) => layer !== null);
  }

  /** The file's text where it is there and was not read yet; while the job runs, the preview's. */
  private async text(name: string): Promise<string | null> {
    return (await (await this.file(name))?.text()) ?? null;
  }

  private async json<T>(name: string): Promise<T | null> {
    const text = await this.text(name);
    return text === null ? null : (JSON.parse(text) as T);
  }

  private async file(name: string): Promise<Response | null> {
    const found = [name, `preview/${name}`].flatMap((n) => this.value.artifacts.filter((a) => a.name === n))[0];
    if (!found || this.read.get(name) === found.sha256) return null;
    try {
      const answer = await ask("GET", `${found.href}?redirect=false`, { signal: this.stop.signal });
      this.read.set(name, found.sha256);
      return answer;
    } catch (error) {
      if (asProblem(error).status === 404) return null; // another preview took its place
      throw error;
    }
  }
}

const SIGNAL = ["still_deg", "trend_db", "level_db"] as const;

const stepping = ({ stage }: JobView) => (stage === "coarse" || stage === "fine" ? stage : null);

/** A line of the curve from a progress event, where it is of a later step than the last one. */
function lineOf(job: JobView, last: CurvePoint | undefined): CurvePoint | null {
  const { loss, psnr, moved_deg } = job.metrics;
  const { step } = job.progress;
  const stage = stepping(job);
  if (!stage || loss === undefined || psnr === undefined || !last || step <= last.step) return null;
  const line = { step, stage, loss, psnr, moved_deg: moved_deg ?? 0 };
  // The detector looks at stage 1 alone; what it saw last stays in the job.
  const signal = stage === "coarse" ? SIGNAL.filter((name) => job.metrics[name] !== undefined) : [];
  return { ...line, ...Object.fromEntries(signal.map((name) => [name, job.metrics[name]])) };
}
