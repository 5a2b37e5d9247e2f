// Requests to the service: URLs, the API key, and errors as `Problem`.
import type { FieldProblem } from "schemas";
import { Store } from "./store";

const KEY_ITEM = "biresnerf-api-key";
/** Between two tries where the service does not say when it wants the request again. */
export const RETRY_MS = 1500;

/** The API key, kept while the tab is open. */
export const apiKey = new Store<string | null>(sessionStorage.getItem(KEY_ITEM));
/** Why the service rejected the request without (or with) this key; null while no key is needed. */
export const keyRequired = new Store<string | null>(null);

/** Uses a key from now on; null forgets it. */
export function setKey(key: string | null): void {
  if (key === null) sessionStorage.removeItem(KEY_ITEM);
  else sessionStorage.setItem(KEY_ITEM, key);
  apiKey.set(key);
  keyRequired.set(null);
}

/** Whether the page shows one job to somebody with a link, who can change nothing. */
export const shared = new Store(false);

/** Uses a link's token in the place of a key until it is left; null goes back to the key. */
export function setLink(token: string | null): void {
  shared.set(token !== null);
  apiKey.set(token ?? sessionStorage.getItem(KEY_ITEM));
}

interface ProblemFields {
  status: number;
  code: string;
  title: string;
  detail: string;
  hint?: string;
  where?: string;
  errors?: readonly FieldProblem[];
  /** Seconds after which the service wants the request again. */
  waitS?: number;
}

/** An error of the service or of the connection to it; it has the fields that it is made of. */
export interface Problem extends Readonly<Required<ProblemFields>> {}
export class Problem extends Error {
  constructor(fields: ProblemFields) {
    super(fields.detail);
    Object.assign(this, { hint: "", where: "", errors: [], waitS: 0, ...fields });
  }

  /** Whether the same request may succeed later. */
  get transient(): boolean {
    return this.status === 0 || this.status === 429 || this.status >= 500;
  }

  /** Milliseconds to wait before the next try. */
  get pauseMs(): number {
    return Math.max(RETRY_MS, 1000 * this.waitS);
  }

  static unreachable(): Problem {
    const title = "The service does not respond";
    const detail = "The connection was refused or lost.";
    return new Problem({ status: 0, code: "unreachable", title, detail, hint: "The page retries by itself." });
  }

  static of(status: number, text: string, retryAfter: string | null): Problem {
    const waitS = Number(retryAfter) || 0;
    try {
      return new Problem({ ...(JSON.parse(text) as ProblemFields), status, waitS });
    } catch {
      const title = `The service responded with status ${status}`;
      return new Problem({ status, code: "unknown", title, detail: text.slice(0, 300), waitS });
    }
  }
}

/** The URL of an API path, relative to the page: a proxy may serve both below a prefix. */
export function address(path: string): string {
  return new URL(path.replace(/^\//, ""), document.baseURI.split("#")[0]).href;
}

export function withKey(headers: Record<string, string> = {}): Record<string, string> {
  return apiKey.value ? { ...headers, Authorization: `Bearer ${apiKey.value}` } : headers;
}

/** Has the page ask for a key if the problem is that one is missing or wrong. */
export function checkKey(problem: Problem): Problem {
  if (problem.status === 401 && !shared.value) keyRequired.set(problem.code === "invalid_api_key" ? problem.detail : "");
  return problem;
}

interface RequestOptions {
  json?: unknown;
  headers?: Record<string, string>;
  signal?: AbortSignal;
}

/** Sends a request. Throws `Problem`. */
export async function request(method: string, path: string, options: RequestOptions = {}): Promise<Response> {
  const headers = withKey(options.headers);
  if (options.json !== undefined) headers["Content-Type"] = "application/json";
  let response: Response;
  try {
    response = await fetch(address(path), {
      method,
      headers,
      body: options.json === undefined ? null : JSON.stringify(options.json),
      signal: options.signal ?? null,
    });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw Problem.unreachable();
  }
  if (response.ok) return response;
  throw checkKey(Problem.of(response.status, await response.text(), response.headers.get("Retry-After")));
}

/** Sends a request and parses the JSON of the response. Throws `Problem`. */
export async function requestJson<T>(method: string, path: string, options: RequestOptions = {}): Promise<T> {
  const response = await request(method, path, options);
  return (response.status === 204 ? undefined : await response.json()) as T;
}

/** Whatever was thrown, as a problem. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  const detail = error instanceof Error ? error.message : String(error);
  return new Problem({ status: 0, code: "page_error", title: "The page failed", detail });
}

export const pause = (ms: number) => new Promise<void>((done) => setTimeout(done, ms));
