// A job's server-sent events, read with fetch: EventSource cannot send an API key.
import type { JobView } from "schemas";
import { address, asProblem, checkKey, pause, Problem, RETRY_MS, withKey } from "./http";

export interface JobEvent {
  seq: number;
  at: string;
  attempt: number;
  type: string;
  data: Record<string, unknown>;
}

interface JobEventHandlers {
  /** The job as it is now; at most once a second. */
  onProgress: (job: JobView) => void;
  /** An event, each once and in order. */
  onEvent: (event: JobEvent) => void;
  /** The connection was made or lost; it is retried. */
  onConnection: (up: boolean) => void;
}

/** Reads a job's events from the first one until it is over. Throws `Problem` if retrying cannot help. */
export async function followJob(jobId: string, handlers: JobEventHandlers, signal: AbortSignal): Promise<void> {
  let last = 0;
  let over = false;
  const handle = (kind: string, data: string) => {
    const message = JSON.parse(data);
    if (kind === "progress") {
      handlers.onProgress(message as JobView);
      return;
    }
    const event = message as JobEvent;
    last = event.seq;
    over ||= ["succeeded", "failed", "cancelled", "expired"].includes(event.type);
    handlers.onEvent(event);
  };
  while (!over && !signal.aborted) {
    let pauseMs = RETRY_MS;
    try {
      const headers = withKey({ Accept: "text/event-stream", "Last-Event-ID": String(last) });
      const response = await fetch(address(`v1/jobs/${jobId}/events`), { headers, signal });
      if (!response.ok) throw checkKey(Problem.of(response.status, await response.text(), response.headers.get("Retry-After")));
      handlers.onConnection(true);
      await read(response, handle);
    } catch (error) {
      if (signal.aborted) return;
      const problem = asProblem(error);
      if (problem.status && !problem.transient) throw problem;
      pauseMs = problem.pauseMs;
    }
    if (!over && !signal.aborted) {
      handlers.onConnection(false);
      await pause(pauseMs);
    }
  }
}

async function read(response: Response, handle: (kind: string, data: string) => void): Promise<void> {
  const reader = response.body!.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop() ?? "";
    for (const block of blocks) {
      let kind = "message";
      const data: string[] = [];
      for (const line of block.split("\n")) {
        if (line.startsWith("event: ")) kind = line.slice(7);
        else if (line.startsWith("data: ")) data.push(line.slice(6));
      }
      if (data.length) handle(kind, data.join("\n"));
    }
  }
}
