// Masks that a user paints for photos of a checked set, and the copy of the set that has them.
import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import type { CheckedPhoto, DatasetView, PhotoList } from "schemas";
import { once, useAttempt, useLoaded } from "../api/hooks";
import type { Problem } from "../api/http";
import type { Chosen } from "../upload/gather";
import { beginCopy } from "../upload/send";
import type { Mask } from "./mask";

const SUFFIX = ", masked";

export interface Masks {
  /** Photos whose masks are not saved yet. */
  readonly painted: ReadonlyMap<number, Mask>;
  readonly edit: (photo: number) => void;
  /** The dialog, while it is open. */
  readonly editor: ComponentChildren;
  readonly save: () => Promise<boolean>;
  readonly busy: boolean;
  readonly problem: Problem | null;
}

/** A checked set never changes: saving makes a copy that has the masks, whose id `onSaved` gets. */
export function useMasks(dataset: DatasetView, list: PhotoList | null, onSaved: (id: string) => void): Masks {
  const [painted, setPainted] = useState<ReadonlyMap<number, Mask>>(new Map());
  const [editing, setEditing] = useState<number | null>(null);
  const { attempt, busy, problem } = useAttempt();
  const wanted = editing !== null;
  const { value: loaded, problem: unloaded } = useLoaded(async () => (wanted ? import("./editor") : null), once, [wanted]);
  const save = () => attempt(async () => onSaved(await beginCopy(dataset, nameOf(dataset), await filesOf(list!, painted))));
  const photo = editing === null ? undefined : list?.photos[editing];
  const those = (have: (other: CheckedPhoto) => boolean) => list?.photos.flatMap((other, index) => (have(other) ? [index] : [])) ?? [];
  const alike = photo && list ? those((other) => other.mask !== null && sameSize(list, photo.camera, other.camera)) : [];
  const sharing = photo ? those(({ mask }) => mask?.path === photo.mask?.path) : [];
  const editor = loaded && photo && editing !== null && (
    <loaded.MaskEditor
      key={editing}
      name={photo.name}
      path={`v1/datasets/${dataset.id}/photos/${editing}`}
      masked={photo.masked}
      painted={painted.get(editing) ?? null}
      others={alike.length - 1}
      onDone={(mask, everywhere) => setPainted(new Map([...painted, ...(everywhere ? alike : sharing).map((one) => [one, mask] as const)]))}
      onClose={() => setEditing(null)}
    />
  );
  return { painted, edit: setEditing, editor, save, busy, problem: problem ?? unloaded };
}

function sameSize({ cameras }: PhotoList, first: number, second: number): boolean {
  const [one, other] = [cameras[first], cameras[second]];
  return one?.width === other?.width && one?.height === other?.height;
}

const nameOf = ({ name }: DatasetView) => (name.endsWith(SUFFIX) ? name : name.slice(0, 200 - SUFFIX.length) + SUFFIX);

async function filesOf({ photos }: PhotoList, painted: ReadonlyMap<number, Mask>): Promise<Chosen[]> {
  const files = new Map<string, Chosen>(); // photos may share a mask's file
  for (const [photo, mask] of painted) {
    const place = photos[photo]?.mask;
    if (!place) continue;
    const file = new File([await mask.png(place.inverted)], place.path.slice(place.path.lastIndexOf("/") + 1));
    files.set(place.path, { path: place.path, file });
  }
  return [...files.values()];
}
