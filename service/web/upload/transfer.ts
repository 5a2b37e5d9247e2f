// An upload on its way: its progress, retries, and requests that report how much they have sent.
import { address, asProblem, checkKey, pause, Problem, withKey } from "../api/http";
import { Store } from "../api/store";

const TRIES = 6;

export interface Transfer {
  phase: "hashing" | "sending" | "checking" | "done" | "stopped";
  files: number;
  filesDone: number;
  /** Files that the service already had. */
  known: number;
  bytes: number;
  bytesDone: number;
  startedAt: number;
  /** The transient problem after which the page is retrying. */
  waiting: string;
  problem: Problem | null;
}

export function newTransfer(files: number, bytes: number): Store<Transfer> {
  return new Store<Transfer>({
    ...{ phase: "hashing", files, filesDone: 0, known: 0, bytes, bytesDone: 0 },
    ...{ startedAt: Date.now(), waiting: "", problem: null },
  });
}

/** Retries after problems that may pass. */
export async function retrying(state: Store<Transfer>, attempt: () => Promise<void>): Promise<void> {
  for (let tried = 1; ; tried += 1) {
    try {
      await attempt();
      if (state.value.waiting) state.change({ waiting: "" });
      return;
    } catch (error) {
      const problem = asProblem(error);
      if (!problem.transient || tried === TRIES) throw problem;
      state.change({ waiting: problem.title });
      await pause(Math.max(1000 * problem.waitS, Math.min(15000, 500 * 2 ** tried)));
    }
  }
}

/** Sends a body and reports how much has been sent, which fetch cannot. */
export function put(
  method: string,
  path: string,
  headers: Record<string, string>,
  body: Blob,
  onSent: (bytes: number) => void,
): Promise<XMLHttpRequest> {
  return new Promise((done, failed) => {
    const request = new XMLHttpRequest();
    request.open(method, address(path));
    for (const [name, value] of Object.entries(withKey(headers))) request.setRequestHeader(name, value);
    if (!("Content-Type" in headers)) request.setRequestHeader("Content-Type", "application/octet-stream");
    request.upload.onprogress = (event) => onSent(event.loaded);
    request.onerror = () => failed(Problem.unreachable());
    request.onload = () => {
      if (request.status < 300) return done(request);
      const problem = Problem.of(request.status, request.responseText, request.getResponseHeader("Retry-After"));
      failed(checkKey(problem));
    };
    request.send(body);
  });
}
