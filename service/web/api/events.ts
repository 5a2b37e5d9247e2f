// A job's server-sent events. Read by fetch: EventSource sends no API key.
import type { JobView } from "schemas";
import { address, asProblem, noteRefusal, pause, Problem, withKey } from "./http";

export interface JobEvent {
  seq: number;
  at: string;
  attempt: number;
  type: string;
  data: Record<string, unknown>;
}

export interface Follower {
  /** How far the job is; once a second at most. */
  onProgress: (job: JobView) => void;
  /** An entry of its history, each once and in order. */
  onEvent: (event: JobEvent) => void;
  /** The connection is there, or not (and is tried again). */
  onLink: (up: boolean) => void;
}

const RETRY_MS = 1500;

/** Follows a job from its first event until it is over; throws `Problem` where asking again is of no use. */
export async function follow(jobId: string, follower: Follower, signal: AbortSignal): Promise<void> {
  let last = 0;
  let over = false;
  const take = (kind: string, data: string) => {
    const said = JSON.parse(data);
    if (kind === "progress") {
      follower.onProgress(said as JobView);
      return;
    }
    const event = said as JobEvent;
    last = event.seq;
    over ||= ["succeeded", "failed", "cancelled", "expired"].includes(event.type);
    follower.onEvent(event);
  };
  while (!over && !signal.aborted) {
    try {
      const headers = withKey({ Accept: "text/event-stream", "Last-Event-ID": String(last) });
      const answer = await fetch(address(`v1/jobs/${jobId}/events`), { headers, signal });
      if (!answer.ok) throw noteRefusal(Problem.of(answer.status, await answer.text(), null));
      follower.onLink(true);
      await read(answer, take);
    } catch (error) {
      if (signal.aborted) return;
      const problem = asProblem(error);
      if (problem.status && !problem.passing) throw problem;
    }
    if (!over && !signal.aborted) {
      follower.onLink(false);
      await pause(RETRY_MS);
    }
  }
}

async function read(answer: Response, take: (kind: string, data: string) => void): Promise<void> {
  const reader = answer.body!.pipeThrough(new TextDecoderStream()).getReader();
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
      if (data.length) take(kind, data.join("\n"));
    }
  }
}
