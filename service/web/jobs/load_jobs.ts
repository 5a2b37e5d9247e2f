// The jobs that the list shows: all that run, then the others in the chosen order.
import type { JobList, JobView } from "schemas";
import { requestJson } from "../api/http";
import { isOver, type JobState, titleOf } from "./state";

/** Jobs per page of the list, and at most per request. */
export const PAGE = 24;
const REQUEST_MAX = 200;
/** So many jobs are searched and sorted. */
export const SEARCHED_MAX = 1000;
/** Between two requests while jobs run, and while none does. */
const BUSY_MS = 1500;
const IDLE_MS = 8000;

export const ORDERS = { newest: "newest first", oldest: "oldest first", name: "by name", longest: "longest run first" } as const;
export type Order = keyof typeof ORDERS;

export interface Wish {
  readonly state: JobState | "";
  readonly order: Order;
  readonly search: string;
  readonly wanted: number;
}

export interface Jobs {
  readonly wish: Wish;
  readonly jobs: readonly JobView[];
  /** Whether there are more. */
  readonly more: boolean;
  /** Whether jobs were left out of a search or an order, which look at the newest alone. */
  readonly cut: boolean;
}

const runs = ({ state }: JobView) => state === "running";

/** Whether the wish needs jobs beyond those that are shown. */
const looksFurther = ({ order, search }: Wish) => order !== "newest" || search.trim() !== "";

export async function loadJobs(wish: Wish, signal: AbortSignal): Promise<Jobs> {
  const { jobs, more } = await newest(wish.state, looksFurther(wish) ? SEARCHED_MAX : wish.wanted, signal);
  // A running job may be older than many that wait.
  const older = more && wish.state === "" ? (await newest("running", SEARCHED_MAX, signal)).jobs : [];
  const known = new Set(jobs.map(({ id }) => id));
  const all = sorted([...jobs, ...older.filter(({ id }) => !known.has(id))], wish.order);
  const words = wish.search.trim().toLocaleLowerCase();
  const found = [...all.filter(runs), ...all.filter((job) => !runs(job))].filter(
    (job) => !words || titleOf(job).toLocaleLowerCase().includes(words) || job.id.toLocaleLowerCase().includes(words),
  );
  const cut = looksFurther(wish) && more;
  return { wish, jobs: found.slice(0, wish.wanted), more: found.length > wish.wanted || (more && !cut), cut };
}

/** How long the list is shown before it is loaded again: the longer it is, the longer. */
export function lasting({ jobs, wish }: Jobs): number {
  const busy = BUSY_MS * Math.ceil((looksFurther(wish) ? SEARCHED_MAX / 4 : jobs.length) / PAGE);
  return jobs.every(isOver) ? IDLE_MS : Math.max(BUSY_MS, busy);
}

/** The newest jobs in a state; "" stands for all states. */
async function newest(state: JobState | "", most: number, signal: AbortSignal): Promise<{ jobs: JobView[]; more: boolean }> {
  const jobs: JobView[] = [];
  let cursor: string | null = null;
  do {
    const limit = String(Math.min(REQUEST_MAX, most - jobs.length));
    const asked = new URLSearchParams({ limit, ...(state && { state }), ...(cursor && { cursor }) });
    const page: JobList = await requestJson<JobList>("GET", `v1/jobs?${asked}`, { signal });
    jobs.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && jobs.length < most);
  return { jobs, more: cursor !== null };
}

const natural = new Intl.Collator("en", { numeric: true });
const took = ({ started_at, finished_at }: JobView) =>
  started_at ? Date.parse(finished_at ?? new Date().toISOString()) - Date.parse(started_at) : 0;

function sorted(jobs: JobView[], order: Order): JobView[] {
  if (order === "oldest") return jobs.reverse();
  if (order === "name") return jobs.sort((a, b) => natural.compare(titleOf(a), titleOf(b)));
  return order === "longest" ? jobs.sort((a, b) => took(b) - took(a)) : jobs;
}
