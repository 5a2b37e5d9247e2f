// The cameras that a set was given, before a job has moved them.
import { useMemo, useState } from "preact/hooks";
import { bordersOf } from "../../../biresnerf/viewer/result/poses";
import type { SceneCamera } from "../../../biresnerf/viewer/result/widget_data";
import { once, useLoaded } from "../api/hooks";
import type { SetPhotos } from "../upload/set_photos";

/** The given cameras in three dimensions; the code for it is loaded for sets that have poses. */
export function GivenCameras({ photos: { list, cellOf }, converted = false }: { photos: SetPhotos; converted?: boolean }) {
  const { value: widgets } = useLoaded(() => import("../job/widgets"), once, []);
  const [selected, setSelected] = useState<number | null>(null);
  const posed = useMemo(() => list.photos.flatMap(({ world_from_cam }, index) => (world_from_cam ? [index] : [])), [list]);
  const cameras = useMemo<SceneCamera[]>(() => {
    const borders = list.cameras.map(bordersOf);
    return posed.map((index) => {
      const { name, camera, world_from_cam, read_as_asked } = list.photos[index]!;
      const pose = (converted && read_as_asked) || world_from_cam!;
      return {
        ...{ name, before: null, after: pose, returned: pose, source: "given", borders: borders[camera]! },
        ...{ moved_deg: 0, moved_units: 0, delta_psnr: null, flags: [], uncertainty: null },
        ...{ part: null, parts_apart_deg: null },
      };
    });
  }, [list, posed, converted]);
  const cellOfPosed = useMemo(() => (camera: number) => cellOf(posed[camera]!), [cellOf, posed]);
  if (!widgets) return <p class="waiting soft">Loading …</p>;
  return <widgets.SceneView cameras={cameras} cellOf={cellOfPosed} selected={selected} onSelect={setSelected} />;
}
