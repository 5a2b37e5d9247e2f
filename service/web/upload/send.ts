// Sends files to the service: only those that it lacks, several at a time, with retries.
import type { DatasetView, FileList, FileView, Info, SizeLimits } from "schemas";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { asProblem, Problem, requestJson } from "../api/http";
import type { Store } from "../api/store";
import { bytes as inBytes } from "../parts/format";
import { type Chosen, type Gathered, isArchive } from "./gather";
import { deleteRejected, sendArchive } from "./resumable";
import { newTransfer, put, retrying, type Transfer } from "./transfer";

const AT_ONCE = 4;
/** Larger files are sent without their digest: hashing holds the whole file in memory. */
const HASHED_MAX_BYTES = 256 * 2 ** 20;

/** Uploads of this tab, by dataset. */
export const transfers = new Map<string, Store<Transfer>>();

/** Throws `Problem` before anything is sent if the service would refuse it. */
function checkLimits(chosen: readonly Chosen[], bytes: number, limits: SizeLimits): void {
  const refuse = (detail: string, errors: { pointer: string; detail: string }[] = []) => {
    const hint = "Send fewer or smaller files, or ask the operator for a higher limit.";
    throw new Problem({ status: 0, code: "too_much", title: "The upload exceeds the limits of this service", detail, hint, errors });
  };
  if (isArchive(chosen)) {
    if (bytes > limits.max_archive_bytes) {
      refuse(`The archive has ${inBytes(bytes)}; the limit is ${inBytes(limits.max_archive_bytes)}.`);
    }
    return;
  }
  const large = chosen.filter(({ file }) => file.size > limits.max_file_bytes);
  if (large.length) {
    const errors = large.slice(0, 20).map(({ path, file }) => ({ pointer: path, detail: inBytes(file.size) }));
    refuse(`${count(large.length, "file")} of more than ${inBytes(limits.max_file_bytes)}.`, errors);
  }
  if (chosen.length > limits.max_files) {
    refuse(`There are ${count(chosen.length, "file")}; the limit is ${limits.max_files}.`);
  }
  if (bytes > limits.max_dataset_bytes) {
    refuse(`The image set has ${inBytes(bytes)}; the limit is ${inBytes(limits.max_dataset_bytes)}.`);
  }
}

interface Entry extends Chosen {
  sha256: string | null;
}

/** Creates a dataset and sends the files in the background; returns its id. Throws `Problem`. */
export async function begin(gathered: Gathered, onHashing: (share: number) => void): Promise<string> {
  const chosen = gathered.files;
  const name = gathered.name.slice(0, 200) || "dataset";
  const bytes = chosen.reduce((sum, { file }) => sum + file.size, 0);
  const state = newTransfer(chosen.length, bytes);
  checkLimits(chosen, bytes, (await requestJson<Info>("GET", "v1/info")).limits);
  if (isArchive(chosen)) {
    const file = chosen[0]!.file;
    return track(await sendArchive(file, name, state), state);
  }
  const entries = await hashed(chosen, bytes, onHashing);
  return create(name, entries, [], state);
}

/** Creates a copy of a checked dataset with files added or replaced; the service copies the others. Throws `Problem`. */
export async function beginCopy(of: DatasetView, name: string, changed: Chosen[]): Promise<string> {
  const bytes = changed.reduce((sum, { file }) => sum + file.size, 0);
  const entries = await hashed(changed, bytes, () => {});
  const replaced = new Set(changed.map(({ path }) => path));
  const kept: FileView[] = [];
  for (let cursor: string | null = ""; cursor !== null; ) {
    const page: FileList = await requestJson("GET", `v1/datasets/${of.id}/files?cursor=${encodeURIComponent(cursor)}`);
    kept.push(...page.items.filter(({ path }) => !replaced.has(path)));
    cursor = page.next_cursor;
  }
  return create(name, entries, kept, newTransfer(changed.length, bytes));
}

async function create(name: string, entries: Entry[], kept: readonly FileView[], state: Store<Transfer>): Promise<string> {
  const sent = entries.map(({ path, file, sha256 }) => ({ path, size: file.size, ...(sha256 && { sha256 }) }));
  const manifest = [...kept.map(({ path, size, sha256 }) => ({ path, size, sha256 })), ...sent];
  const dataset = await requestJson<DatasetView>("POST", "v1/datasets", { json: { name, manifest } });
  return track({ dataset: dataset.id, sent: sendMissing(dataset, entries, state) }, state);
}

/** Resumes the upload of a dataset. Throws `Problem` if files are missing among those chosen. */
export async function resume(dataset: DatasetView, chosen: Chosen[]): Promise<void> {
  const bytes = chosen.reduce((sum, { file }) => sum + file.size, 0);
  const state = newTransfer(chosen.length, bytes);
  const unlisted = dataset.missing.length === 0; // an archive, or a folder instead of one
  if (unlisted && isArchive(chosen)) {
    track(await sendArchive(chosen[0]!.file, dataset.name, state, dataset.id), state);
    return;
  }
  const have = new Set(chosen.map(({ path }) => path));
  const lacking = dataset.missing.filter((path) => !have.has(path));
  if (lacking.length) {
    const detail = `${lacking.length} of the missing files are not among those chosen, for example ${lacking[0]}.`;
    const hint = "Choose the folder that was sent before.";
    throw new Problem({ status: 0, code: "other_files", title: "Different files", detail, hint });
  }
  const entries = chosen.map((item) => ({ ...item, sha256: null }));
  const wanted = unlisted ? { ...dataset, missing: [...have] } : dataset;
  track({ dataset: dataset.id, sent: sendMissing(wanted, entries, state) }, state);
}

/** Has a dataset checked whose files have all arrived. */
export function checkArrived(dataset: DatasetView): void {
  const { files, bytes } = dataset;
  const state = newTransfer(files, bytes);
  state.change({ filesDone: files, bytesDone: bytes });
  track({ dataset: dataset.id, sent: Promise.resolve() }, state);
}

function track(started: { dataset: string; upload?: string; sent: Promise<void> }, state: Store<Transfer>): string {
  transfers.set(started.dataset, state);
  started.sent
    .then(() => finalize(started.dataset, started.upload, state))
    .catch((error) => state.change({ phase: "stopped", problem: asProblem(error) }));
  return started.dataset;
}

async function finalize(dataset: string, upload: string | undefined, state: Store<Transfer>): Promise<void> {
  state.change({ phase: "checking", waiting: "" });
  try {
    await requestJson("POST", `v1/datasets/${dataset}/finalize`, { headers: { Prefer: "respond-async" } });
  } catch (error) {
    if (asProblem(error).status !== 422) throw error;
    // What the check found wrong is part of the dataset; the page shows it from there.
    const seen = await requestJson<DatasetView>("GET", `v1/datasets/${dataset}`);
    if (seen.state === "open") throw (upload && (await deleteRejected(upload))) || error;
  }
  state.change({ phase: "done" });
}

async function hashed(chosen: Chosen[], bytes: number, onHashing: (share: number) => void): Promise<Entry[]> {
  // Browsers offer digests on HTTPS and localhost only.
  const subtle = globalThis.crypto?.subtle;
  const entries: Entry[] = [];
  let done = 0;
  for (const item of chosen) {
    const digest = subtle && item.file.size <= HASHED_MAX_BYTES;
    entries.push({ ...item, sha256: digest ? hex(await subtle.digest("SHA-256", await item.file.arrayBuffer())) : null });
    done += item.file.size;
    onHashing(bytes ? done / bytes : 1);
  }
  return entries;
}

async function sendMissing(dataset: DatasetView, entries: Entry[], state: Store<Transfer>): Promise<void> {
  const missing = new Set(dataset.missing);
  const queue = entries.filter(({ path }) => missing.has(path));
  const known = entries.length - queue.length;
  const knownBytes = entries.filter(({ path }) => !missing.has(path)).reduce((sum, { file }) => sum + file.size, 0);
  state.change({ phase: "sending", filesDone: known, known, bytesDone: knownBytes });
  const lane = async () => {
    for (let entry = queue.shift(); entry; entry = queue.shift()) {
      try {
        await sendFile(dataset.id, entry, state);
      } catch (error) {
        queue.length = 0; // the other lanes finish their current file
        throw error;
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, lane));
}

async function sendFile(dataset: string, entry: Entry, state: Store<Transfer>): Promise<void> {
  const path = entry.path.split("/").map(encodeURIComponent).join("/");
  const headers: Record<string, string> = entry.sha256 ? { "Repr-Digest": `sha-256=:${base64(entry.sha256)}:` } : {};
  let reported = 0;
  const onSent = (sent: number) => {
    state.change({ bytesDone: state.value.bytesDone + sent - reported });
    reported = sent;
  };
  try {
    await retrying(state, async () => {
      onSent(0);
      await put("PUT", `v1/datasets/${dataset}/files/${path}`, headers, entry.file, onSent);
    });
  } catch (error) {
    const problem = asProblem(error);
    throw new Problem({ ...problem, where: problem.where || entry.path });
  }
  onSent(entry.file.size);
  state.change({ filesDone: state.value.filesDone + 1 });
}

function hex(digest: ArrayBuffer): string {
  return [...new Uint8Array(digest)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

function base64(sha256: string): string {
  return btoa(sha256.replace(/../g, (pair) => String.fromCharCode(parseInt(pair, 16))));
}
