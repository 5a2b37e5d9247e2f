// The photos of a checked set: the list with given poses, and where each lies in the one picture of all.
import { useMemo } from "preact/hooks";
import type { PhotoList } from "schemas";
import { cellsIn, type SheetCell } from "../../../biresnerf/viewer/result/widget_data";
import { once, useLoaded } from "../api/hooks";
import { requestJson } from "../api/http";
import { useServed } from "../api/picture_urls";

export interface SetPhotos {
  readonly list: PhotoList;
  /** Null while the picture is on its way, or for sets with too many photos. */
  readonly cellOf: (photo: number) => SheetCell | null;
}

const NONE = () => null;

/** The photos of a set; null until they are known. */
export function useSet(dataset: string | null): SetPhotos | null {
  const load = async (signal: AbortSignal) =>
    dataset === null ? null : requestJson<PhotoList>("GET", `v1/datasets/${dataset}/photos`, { signal });
  const { value: list } = useLoaded(load, once, [dataset]);
  const url = useServed(list?.sheet && dataset ? `v1/datasets/${dataset}/photos.jpg` : null);
  return useMemo(() => {
    if (!list) return null;
    const cellOf = list.sheet && url ? cellsIn(list.sheet, url, list.photos.length) : NONE;
    return { list, cellOf };
  }, [list, url]);
}

/** Where a job's photos lie in the picture of its set, while the job has none of its own. */
export function useSetPhotos(dataset: string | null, names: readonly string[]): (image: number) => SheetCell | null {
  const set = useSet(dataset);
  return useMemo(() => {
    if (!set) return NONE;
    const row = new Map(set.list.photos.map(({ name }, index) => [name, index]));
    return (image: number) => {
      const found = row.get(names[image] ?? "");
      return found === undefined ? null : set.cellOf(found);
    };
  }, [set, names]);
}
