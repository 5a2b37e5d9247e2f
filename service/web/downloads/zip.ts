// Several files as one zip, stored as they are: pictures and binary models gain nothing from packing. What is in it is
// held as blobs, which browsers keep on disk where they are large: of a folder of photos one is in memory at a time.

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  let c = n;
  for (let bit = 0; bit < 8; bit += 1) c = c & 1 ? (c >>> 1) ^ 0xedb88320 : c >>> 1;
  return c;
});

function crc32(bytes: Uint8Array): number {
  let c = 0xffffffff;
  for (const byte of bytes) c = TABLE[(c ^ byte) & 255]! ^ (c >>> 8);
  return (c ^ 0xffffffff) >>> 0;
}

/** Bytes of little-endian numbers, each of a width of 2 or 4. */
function packed(...fields: [number, 2 | 4][]): Uint8Array<ArrayBuffer> {
  const view = new DataView(new ArrayBuffer(fields.reduce((sum, [, width]) => sum + width, 0)));
  let at = 0;
  for (const [value, width] of fields) {
    if (width === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += width;
  }
  return new Uint8Array(view.buffer);
}

const UTF8_NAMES = 0x0800;
/** 1 January 1980, the first day that the format knows. */
const DAY = 0x0021;
/** Beyond these the format needs its 64-bit form, which is not written here. */
const BYTES_MAX = 0xfffffffe;
const FILES_MAX = 0xfffe;

/** What `Zip` makes of such files; none: they are too much for it. */
export function fitsOneZip(sizes: readonly number[]): boolean {
  return sizes.length <= FILES_MAX && sizes.reduce((sum, size) => sum + size, 0) <= BYTES_MAX;
}

export class Zip {
  private readonly parts: BlobPart[] = [];
  private readonly directory: BlobPart[] = [];
  private at = 0;
  private files = 0;

  /** Throws where there is too much for one zip. */
  async add(name: string, content: Blob): Promise<void> {
    const path = new TextEncoder().encode(name);
    const crc = crc32(new Uint8Array(await content.arrayBuffer()));
    const common: [number, 2 | 4][] = [
      ...([[20, 2], [UTF8_NAMES, 2], [0, 2], [0, 2], [DAY, 2]] as [number, 2][]),
      ...([[crc, 4], [content.size, 4], [content.size, 4]] as [number, 4][]),
      ...([[path.length, 2], [0, 2]] as [number, 2][]),
    ];
    if (this.at + content.size > BYTES_MAX || this.files >= FILES_MAX) throw new Error("Too much for one zip.");
    const head = packed([0x04034b50, 4], ...common);
    this.directory.push(packed([0x02014b50, 4], [20, 2], ...common, [0, 2], [0, 2], [0, 2], [0, 4], [this.at, 4]), path);
    this.parts.push(head, path, content);
    this.at += head.length + path.length + content.size;
    this.files += 1;
  }

  finish(): Blob {
    const directory = new Blob(this.directory);
    const counts: [number, 2][] = [[0, 2], [0, 2], [this.files, 2], [this.files, 2]];
    const end = packed([0x06054b50, 4], ...counts, [directory.size, 4], [this.at, 4], [0, 2]);
    return new Blob([...this.parts, directory, end], { type: "application/zip" });
  }
}
