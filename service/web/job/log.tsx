// The log of the job's process, live while it runs.
import { useRef, useState } from "preact/hooks";
import type { JobView } from "schemas";
import { useLoaded } from "../api/hooks";
import { request } from "../api/http";
import { isOver } from "../jobs/state";

const EVERY_MS = 1500;
const LINES_MAX = 2000;

interface LogLine {
  n: number;
  text: string;
}

export function LogView({ job }: { job: JobView }) {
  const [open, setOpen] = useState(false);
  return (
    <details class="panel" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <h2>Log</h2>
      </summary>
      {open && <Lines job={job} />}
    </details>
  );
}

function Lines({ job }: { job: JobView }) {
  const lines = useRef<LogLine[]>([]);
  const over = useRef(false);
  over.current = isOver(job);
  const load = async (signal: AbortSignal) => {
    const done = over.current; // read before the request, so that no line written in between is missed
    const path = `v1/jobs/${job.id}/logs?format=ndjson&after=${lines.current.at(-1)?.n ?? 0}`;
    const text = await (await request("GET", path, { signal })).text();
    const fresh = text.split("\n").filter(Boolean).map((line) => JSON.parse(line) as LogLine);
    lines.current = [...lines.current, ...fresh].slice(-LINES_MAX);
    return { complete: done && !fresh.length };
  };
  useLoaded(load, ({ complete }) => (complete ? null : EVERY_MS), [job.id]);
  return (
    <pre class="log" tabIndex={0} aria-label="Log">
      {lines.current.map((line) => `${line.text}\n`)}
    </pre>
  );
}
