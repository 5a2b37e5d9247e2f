// What the operator sees: the queue, what each slot does, sizes, and which jobs failed last.
import type { Info, OperatorView, SlotView } from "schemas";
import { ScrolledTable } from "../../../biresnerf/viewer/widgets/controls";
import { worded } from "../../../biresnerf/viewer/widgets/option_words";
import { duration } from "../../../biresnerf/viewer/widgets/numbers";
import { once, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { HEADINGS } from "../job/failure";
import { STAGE_WORDS } from "../jobs/state";
import { bytes, moment, percent } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { useTitle } from "../parts/title";

const AGAIN_MS = 3000;

/** The way to this page, for a key with the scope `admin`. */
export function OperatorLink({ here }: { here: boolean }) {
  const { value: info } = useLoaded((signal) => requestJson<Info>("GET", "v1/info", { signal }), once, []);
  if (!info?.scopes.includes("admin")) return null;
  return (
    <a href="#/operator" aria-current={here ? "page" : undefined}>
      Operator
    </a>
  );
}

export function OperatorPage() {
  const { value: seen, problem } = useLoaded(
    (signal) => requestJson<OperatorView>("GET", "v1/operator", { signal }),
    () => AGAIN_MS,
    [],
  );
  useTitle("Operator");
  if (problem) return <ProblemBox problem={problem} />;
  if (!seen) return <p class="soft">Loading …</p>;
  const ago = (time: string | null) => (time ? duration(Math.max(0, Date.parse(seen.at) - Date.parse(time)) / 1000) : "–");
  return (
    <article class="job">
      <header class="page-head">
        <h1>The service at work</h1>
      </header>
      <div class="panel">
        <h2>Queue</h2>
        <Rows
          label="Queue"
          names={["priority", "waiting", "held", "running", "oldest waits for"]}
          rows={seen.queue.map((row) => [row.priority, row.waiting, row.held, row.running, ago(row.oldest_at)])}
        />
      </div>
      <div class="panel">
        <h2>Slots</h2>
        <Rows
          label="Slots"
          names={["slot", "last beat", "job", "tenant", "stage", "for"]}
          rows={seen.slots.flatMap((slot) => slotRows(slot, ago))}
        />
      </div>
      <div class="panel">
        <h2>Sizes</h2>
        <Rows
          label="Sizes"
          names={["stored", "database", "room for uploads", "folders to delete", "webhooks to send"]}
          rows={[
            [bytes(seen.stored_bytes), bytes(seen.database_bytes), bytes(seen.upload_room_bytes), seen.trash, seen.webhooks_pending],
          ]}
        />
      </div>
      <div class="panel">
        <h2>Last failures</h2>
        <Rows
          label="Last failures"
          names={["job", "tenant", "failed", "why"]}
          rows={seen.failures.map(({ id, tenant, finished_at, code, detail }) => [
            id,
            tenant,
            moment(finished_at),
            `${HEADINGS[code ?? ""] ?? "The job failed"}: ${worded(detail ?? "")}`,
          ])}
        />
      </div>
    </article>
  );
}

type Cells = readonly (string | number)[];

/** One for each job of the slot, or one that says that it has none. */
function slotRows(slot: SlotView, ago: (time: string | null) => string): Cells[] {
  const own = [`${slot.host} ${slot.name}`, `${ago(slot.beat_at)} ago${slot.alive ? "" : ", lost"}`];
  if (slot.jobs.length === 0) return [[...own, "none", "", "", ""]];
  return slot.jobs.map((job) => {
    const stage = job.kind === "export" ? "Export" : job.stage ? STAGE_WORDS[job.stage] : "Starting";
    return [...own, job.id, job.tenant, `${stage}, ${percent(job.fraction)}`, ago(job.since)];
  });
}

function Rows({ label, names, rows }: { label: string; names: readonly string[]; rows: readonly Cells[] }) {
  if (rows.length === 0) return <p class="soft">None.</p>;
  return (
    <ScrolledTable label={label}>
      <thead>
        <tr>
          {names.map((name) => (
            <th scope="col" key={name}>
              {name}
            </th>
          ))}
        </tr>
      </thead>
      <tbody>
        {rows.map((cells, index) => (
          <tr key={index}>
            {cells.map((cell, column) => (
              <td key={column}>{cell}</td>
            ))}
          </tr>
        ))}
      </tbody>
    </ScrolledTable>
  );
}
