// Requests to the service: addresses, the API key, and errors as the problems that it tells.
import { Store } from "./store";

const KEY_PLACE = "biresnerf-api-key";

/** The API key; kept for as long as the tab is open. */
export const apiKey = new Store<string | null>(sessionStorage.getItem(KEY_PLACE));
/** Why the service wants a key, once it has said so. */
export const keyWanted = new Store<string | null>(null);

export function useKey(key: string): void {
  sessionStorage.setItem(KEY_PLACE, key);
  apiKey.set(key);
  keyWanted.set(null);
}

export function forgetKey(): void {
  sessionStorage.removeItem(KEY_PLACE);
  apiKey.set(null);
}

export interface FieldProblem {
  pointer: string;
  detail: string;
}

/** What the service (or the way to it) says went wrong. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    readonly title: string,
    readonly detail: string,
    readonly hint: string = "",
    readonly where: string = "",
    readonly errors: readonly FieldProblem[] = [],
    readonly waitS: number = 0,
  ) {
    super(detail);
  }

  /** Whether the same request may succeed later. */
  get passing(): boolean {
    return this.status === 0 || this.status === 429 || this.status >= 500;
  }

  /** The same of a place, unless it names one. */
  at(place: string): Problem {
    const { status, code, title, detail, hint, where, errors, waitS } = this;
    return new Problem(status, code, title, detail, hint, where || place, errors, waitS);
  }

  static unreachable(): Problem {
    return new Problem(
      0,
      "unreachable",
      "The service does not answer",
      "The connection was refused or broke off.",
      "The page tries again by itself.",
    );
  }

  static of(status: number, text: string, retryAfter: string | null): Problem {
    const waitS = Number(retryAfter) || 0;
    try {
      const said = JSON.parse(text);
      return new Problem(
        ...([status, String(said.code), String(said.title), String(said.detail)] as const),
        ...([said.hint ?? "", said.where ?? "", said.errors ?? [], waitS] as const),
      );
    } catch {
      return new Problem(status, "unknown", `The service answered ${status}`, text.slice(0, 300), "", "", [], waitS);
    }
  }
}

/** A path of the interface as an address, also where a proxy serves the page below a folder. */
export function address(path: string): string {
  return new URL(path.replace(/^\//, ""), document.baseURI.split("#")[0]).href;
}

export function withKey(headers: Record<string, string> = {}): Record<string, string> {
  return apiKey.value ? { ...headers, Authorization: `Bearer ${apiKey.value}` } : headers;
}

/** Takes note of a wish for a key; the page then asks for one. */
export function noteRefusal(problem: Problem): Problem {
  if (problem.status === 401) keyWanted.set(problem.code === "invalid_api_key" ? problem.detail : "");
  return problem;
}

export interface Asked {
  json?: unknown;
  headers?: Record<string, string>;
  signal?: AbortSignal;
}

/** The answer itself; throws `Problem`. */
export async function ask(method: string, path: string, asked: Asked = {}): Promise<Response> {
  const headers = withKey(asked.headers);
  if (asked.json !== undefined) headers["Content-Type"] = "application/json";
  let answer: Response;
  try {
    answer = await fetch(address(path), {
      method,
      headers,
      body: asked.json === undefined ? null : JSON.stringify(asked.json),
      signal: asked.signal ?? null,
    });
  } catch (error) {
    if (asked.signal?.aborted) throw error;
    throw Problem.unreachable();
  }
  if (answer.ok) return answer;
  throw noteRefusal(Problem.of(answer.status, await answer.text(), answer.headers.get("Retry-After")));
}

/** The answer's JSON; throws `Problem`. */
export async function call<T>(method: string, path: string, asked: Asked = {}): Promise<T> {
  const answer = await ask(method, path, asked);
  return (answer.status === 204 ? undefined : await answer.json()) as T;
}

/** As a problem, whatever was thrown. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  return new Problem(0, "page_error", "The page failed", error instanceof Error ? error.message : String(error));
}

export const pause = (ms: number) => new Promise<void>((done) => setTimeout(done, ms));
