// Archives go by tus 1.0: in pieces, on from the last byte that arrived, also after the page was loaded anew.
import type { DatasetView, UploadView } from "../service/answers";
import { ask, asProblem, call } from "../service/http";
import type { Store } from "../service/store";
import { persistently, put, type Sending } from "./send";

const PIECE_BYTES = 16 * 2 ** 20;
const TUS = { "Tus-Resumable": "1.0.0" };

interface Begun {
  dataset: string;
  upload: string;
}

/** Begins, or goes on with what was begun for the same file; the promise `sent` ends with the last byte. */
export async function sendArchive(
  file: File,
  name: string,
  state: Store<Sending>,
): Promise<{ dataset: string; sent: Promise<void> }> {
  const place = `biresnerf-upload ${file.name} ${file.size} ${file.lastModified}`;
  const begun = (await remembered(place)) ?? (await fresh(file, name));
  localStorage.setItem(place, JSON.stringify(begun));
  const sent = sendPieces(begun.upload, file, state).then(() => localStorage.removeItem(place));
  return { dataset: begun.dataset, sent };
}

async function remembered(place: string): Promise<Begun | null> {
  const text = localStorage.getItem(place);
  if (!text) return null;
  const begun = JSON.parse(text) as Begun;
  try {
    const upload = await call<UploadView>("GET", `v1/uploads/${begun.upload}`);
    return upload.state === "receiving" ? begun : null;
  } catch (error) {
    if (asProblem(error).passing) throw error;
    return null; // given up meanwhile
  }
}

async function fresh(file: File, name: string): Promise<Begun> {
  const dataset = await call<DatasetView>("POST", "v1/datasets", { json: { name } });
  const headers = { ...TUS, "Upload-Length": String(file.size) };
  const upload = await call<UploadView>("POST", `v1/datasets/${dataset.id}/uploads`, { headers });
  return { dataset: dataset.id, upload: upload.id };
}

async function sendPieces(upload: string, file: File, state: Store<Sending>): Promise<void> {
  state.change({ phase: "sending" });
  let offset = await offsetOf(upload);
  while (offset < file.size) {
    await persistently(state, async () => {
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
