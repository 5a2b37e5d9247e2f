// Archives go by tus 1.0: in pieces, on from the last byte that arrived, also after the page was loaded anew.
import type { DatasetView, UploadView } from "schemas";
import { ask, asProblem, call, Problem } from "../api/http";
import type { Store } from "../api/store";
import { put, retrying, type Transfer } from "./transfer";

const PIECE_BYTES = 16 * 2 ** 20;
const TUS = { "Tus-Resumable": "1.0.0" };

interface Begun {
  dataset: string;
  upload: string;
}

export interface ArchiveSent {
  dataset: string;
  upload: string;
  /** Ends with the last byte. */
  sent: Promise<void>;
}

/** Begins, or goes on with what was begun for the same file; `dataset`: the one that it has to go into. */
export async function sendArchive(
  file: File,
  name: string,
  state: Store<Transfer>,
  dataset?: string,
): Promise<ArchiveSent> {
  const place = `biresnerf-upload ${file.name} ${file.size} ${file.lastModified}`;
  const known = await remembered(place);
  const begun = known && (dataset ?? known.dataset) === known.dataset ? known : await fresh(file, name, dataset);
  localStorage.setItem(place, JSON.stringify(begun));
  const sent = sendPieces(begun.upload, file, state).then(() => localStorage.removeItem(place));
  return { ...begun, sent };
}

async function remembered(place: string): Promise<Begun | null> {
  const text = localStorage.getItem(place);
  if (!text) return null;
  const begun = JSON.parse(text) as Begun;
  try {
    const upload = await call<UploadView>("GET", `v1/uploads/${begun.upload}`);
    return upload.state === "rejected" ? null : begun;
  } catch (error) {
    if (asProblem(error).passing) throw error;
    return null; // given up meanwhile
  }
}

async function fresh(file: File, name: string, known?: string): Promise<Begun> {
  const dataset = known ?? (await call<DatasetView>("POST", "v1/datasets", { json: { name } })).id;
  const headers = { ...TUS, "Upload-Length": String(file.size) };
  const upload = await call<UploadView>("POST", `v1/datasets/${dataset}/uploads`, { headers });
  return { dataset, upload: upload.id };
}

/** Gives an archive up that the service could not take, so that another can take its place; why it could not. */
export async function giveUpRejected(upload: string): Promise<Problem | null> {
  const { state, error } = await call<UploadView>("GET", `v1/uploads/${upload}`);
  if (state !== "rejected" || !error) return null;
  await call("DELETE", `v1/uploads/${upload}`, { headers: TUS });
  return new Problem(422, error.code, "The archive was not accepted", error.detail, error.hint, error.where);
}

async function sendPieces(upload: string, file: File, state: Store<Transfer>): Promise<void> {
  state.change({ phase: "sending" });
  let offset = await offsetOf(upload);
  while (offset < file.size) {
    await retrying(state, async () => {
      offset = await offsetOf(upload); // as the service has it, whatever went wrong before
      if (offset >= file.size) return;
      const headers = {
        ...TUS,
        "Upload-Offset": String(offset),
        "Content-Type": "application/offset+octet-stream",
      };
      const piece = file.slice(offset, offset + PIECE_BYTES);
      const answer = await put("PATCH", `v1/uploads/${upload}`, headers, piece, (sent) =>
        state.change({ bytesDone: offset + sent }),
      );
      offset = Number(answer.getResponseHeader("Upload-Offset"));
    });
    state.change({ bytesDone: offset });
  }
  state.change({ filesDone: 1 });
}

async function offsetOf(upload: string): Promise<number> {
  const answer = await ask("HEAD", `v1/uploads/${upload}`, { headers: TUS });
  return Number(answer.headers.get("Upload-Offset"));
}
