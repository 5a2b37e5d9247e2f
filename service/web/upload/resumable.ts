// Archives are sent by tus 1.0: in pieces, continuing after the last byte that arrived, even after a reload. Not by
// tus-js-client: it would nearly double the script of the page (16 kB packed) and does not wait as Retry-After says.
import type { DatasetView, UploadView } from "schemas";
import { asProblem, Problem, request, requestJson } from "../api/http";
import type { Store } from "../api/store";
import { put, retrying, type Transfer } from "./transfer";

const PIECE_BYTES = 16 * 2 ** 20;
const TUS = { "Tus-Resumable": "1.0.0" };

interface Started {
  dataset: string;
  upload: string;
}

interface ArchiveSent extends Started {
  /** Resolves when the last byte has arrived. */
  sent: Promise<void>;
}

/** Starts sending an archive, or continues with the same file, into `dataset` or a new one. */
export async function sendArchive(file: File, name: string, state: Store<Transfer>, dataset?: string): Promise<ArchiveSent> {
  const item = `biresnerf-upload ${file.name} ${file.size} ${file.lastModified}`;
  const known = await resumable(item);
  const started = known && (dataset ?? known.dataset) === known.dataset ? known : await create(file, name, dataset);
  localStorage.setItem(item, JSON.stringify(started));
  const sent = sendPieces(started.upload, file, state).then(() => localStorage.removeItem(item));
  return { ...started, sent };
}

async function resumable(item: string): Promise<Started | null> {
  const text = localStorage.getItem(item);
  if (!text) return null;
  const started = JSON.parse(text) as Started;
  try {
    const upload = await requestJson<UploadView>("GET", `v1/uploads/${started.upload}`);
    return upload.state === "rejected" ? null : started;
  } catch (error) {
    if (asProblem(error).transient) throw error;
    return null; // deleted or expired meanwhile
  }
}

async function create(file: File, name: string, known?: string): Promise<Started> {
  const dataset = known ?? (await requestJson<DatasetView>("POST", "v1/datasets", { json: { name } })).id;
  const headers = { ...TUS, "Upload-Length": String(file.size) };
  const upload = await requestJson<UploadView>("POST", `v1/datasets/${dataset}/uploads`, { headers });
  return { dataset, upload: upload.id };
}

/** Deletes an archive that the service rejected, so that another can be sent; returns the reason. */
export async function deleteRejected(upload: string): Promise<Problem | null> {
  const { state, error } = await requestJson<UploadView>("GET", `v1/uploads/${upload}`);
  if (state !== "rejected" || !error) return null;
  await requestJson("DELETE", `v1/uploads/${upload}`, { headers: TUS });
  return new Problem({ ...error, status: 422, title: "The archive was rejected" });
}

async function sendPieces(upload: string, file: File, state: Store<Transfer>): Promise<void> {
  state.change({ phase: "sending" });
  let offset = await offsetOf(upload);
  while (offset < file.size) {
    await retrying(state, async () => {
      offset = await offsetOf(upload); // the service knows what has arrived
      if (offset >= file.size) return;
      const headers = { ...TUS, "Upload-Offset": String(offset), "Content-Type": "application/offset+octet-stream" };
      const piece = file.slice(offset, offset + PIECE_BYTES);
      const response = await put("PATCH", `v1/uploads/${upload}`, headers, piece, (sent) =>
        state.change({ bytesDone: offset + sent }),
      );
      offset = Number(response.getResponseHeader("Upload-Offset"));
    });
    state.change({ bytesDone: offset });
  }
  state.change({ filesDone: 1 });
}

async function offsetOf(upload: string): Promise<number> {
  const response = await request("HEAD", `v1/uploads/${upload}`, { headers: TUS });
  return Number(response.headers.get("Upload-Offset"));
}
