// Dropped or chosen files with their paths.

export interface Chosen {
  path: string;
  file: File;
}

/** The files of one choice. */
export interface Gathered {
  /** Of the folder or archive: names the image set. */
  name: string;
  files: Chosen[];
}

const ARCHIVE = /\.(zip|tar|tar\.gz|tgz)$/i;
const LEFT_OUT = /(^|\/)(\.[^/]*|__MACOSX|Thumbs\.db|desktop\.ini)(\/|$)/;

export function isArchive(chosen: readonly Chosen[]): boolean {
  return chosen.length === 1 && ARCHIVE.test(chosen[0]!.file.name);
}

/** All files in what was dropped. Must be called in the event handler: entries are gone afterwards. */
export async function fromDrop(data: DataTransfer): Promise<Gathered> {
  const found: Chosen[] = [];
  const entries: FileSystemEntry[] = [];
  for (const item of data.items) {
    const entry = item.webkitGetAsEntry();
    const file = entry ? null : item.getAsFile(); // files from another program may have no entry
    if (entry) entries.push(entry);
    else if (file) found.push({ path: file.name, file });
  }
  for (const entry of entries) await walk(entry, "", found);
  return tidy(found);
}

export function fromInput(files: FileList): Gathered {
  return tidy([...files].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
}

async function walk(entry: FileSystemEntry, below: string, found: Chosen[]): Promise<void> {
  const path = below + entry.name;
  if (entry.isFile) {
    const file = await new Promise<File>((done, failed) => (entry as FileSystemFileEntry).file(done, failed));
    found.push({ path, file });
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    // A reader returns some entries per call, and none at the end.
    const some = await new Promise<FileSystemEntry[]>((done, failed) => reader.readEntries(done, failed));
    if (!some.length) return;
    for (const inner of some) await walk(inner, `${path}/`, found);
  }
}

/** Of files in no folder of their own, by which the set is found again in a list. */
function nameOf([first, ...others]: Chosen[]): string {
  const name = first?.file.name.replace(/\.\w+$/, "") ?? "";
  return others.length ? `${name} and ${others.length} more` : name;
}

/** Without files of the operating system, and without a folder around everything. */
function tidy(chosen: Chosen[]): Gathered {
  const kept = chosen.filter(({ path }) => !LEFT_OUT.test(path));
  kept.sort((a, b) => (a.path < b.path ? -1 : 1));
  if (isArchive(kept)) return { name: kept[0]!.file.name.replace(ARCHIVE, ""), files: kept };
  const top = kept[0]?.path.split("/")[0];
  const wraps = kept.every(({ path }) => path.includes("/") && path.split("/")[0] === top);
  // These names have a meaning to the readers.
  if (!wraps || !top || ["images", "sparse", "colmap"].includes(top)) return { name: nameOf(kept), files: kept };
  return { name: top, files: kept.map(({ path, file }) => ({ path: path.slice(top.length + 1), file })) };
}
