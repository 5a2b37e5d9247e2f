// The log of the job's process, live while it runs.
import { useEffect, useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { pause, request } from "../api/http";
import { isOver } from "../jobs/state";

const EVERY_MS = 1500;
const LINES_MAX = 2000;

interface LogLine {
  n: number;
  text: string;
}

export function LogView({ job }: { job: JobView }) {
  const [open, setOpen] = useState(false);
  const [lines, setLines] = useState<LogLine[]>([]);
  const over = useRef(isOver(job));
  over.current = isOver(job);
  useEffect(() => {
    if (!open) return;
    const stop = new AbortController();
    void (async () => {
      let last = 0;
      while (!stop.signal.aborted) {
        const done = over.current; // read before the request, so that no line written in between is missed
        try {
          const path = `v1/jobs/${job.id}/logs?format=ndjson&after=${last}`;
          const text = await (await request("GET", path, { signal: stop.signal })).text();
          const fresh = text.split("\n").filter(Boolean).map((line) => JSON.parse(line) as LogLine);
          last = fresh.at(-1)?.n ?? last;
          if (fresh.length) setLines((seen) => [...seen, ...fresh].slice(-LINES_MAX));
          else if (done) return;
        } catch {
          if (stop.signal.aborted) return; // else the next request tries again
        }
        await pause(EVERY_MS);
      }
    })();
    return () => {
      stop.abort();
      setLines([]);
    };
  }, [open, job.id]);
  return (
    <details class="panel" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <h2>Log</h2>
      </summary>
      <pre class="log" tabIndex={0} aria-label="Log">
        {lines.map((line) => `${line.text}\n`)}
      </pre>
    </details>
  );
}
