// An image set whose files have not all come: what the service fetches itself, or how to send the rest.
import type { DatasetView, UploadList, UploadView } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { bytes } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";
import { ResumeUpload } from "./resume_upload";

const POLL_MS = 1000;
const PROBLEMS_MOST = 5;

export function Unfinished({ dataset, onStarted }: { dataset: DatasetView; onStarted: () => void }) {
  const { value: fetches, problem } = useLoaded(
    (signal) => requestJson<UploadList>("GET", `v1/datasets/${dataset.id}/fetches`, { signal }),
    ({ items }) => (items.length ? POLL_MS : null),
    [dataset.id],
  );
  if (problem) return <ProblemBox problem={problem} />;
  if (!fetches) return null;
  return fetches.items.length ? <Fetches uploads={fetches.items} /> : <ResumeUpload {...{ dataset, onStarted }} />;
}

function Fetches({ uploads }: { uploads: readonly UploadView[] }) {
  const coming = uploads.filter(({ error }) => !error);
  const refused = uploads.flatMap(({ error }) => error ?? []);
  const hosts = [...new Set(coming.map(({ host }) => host))].join(", ");
  const arrived = coming.reduce((sum, { received }) => sum + received, 0);
  return (
    <section class="card" aria-label="Files that the service fetches">
      {coming.length > 0 && (
        <p role="status">
          The service fetches {count(coming.length, "file")} from {hosts}; {bytes(arrived)} arrived so far.
        </p>
      )}
      {refused.slice(0, PROBLEMS_MOST).map((error) => (
        <ProblemBox key={error.where + error.detail} problem={error} heading="A file could not be fetched" />
      ))}
      {refused.length > PROBLEMS_MOST && (
        <p>{count(refused.length - PROBLEMS_MOST, "other file")} could not be fetched either.</p>
      )}
    </section>
  );
}
