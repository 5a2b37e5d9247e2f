// Stands in for the three-dimensional view if the browser has no WebGL.
import { centreOf, type Triple } from "../result/poses";
import type { SceneCamera } from "../result/widget_data";
import { ScrolledTable } from "../widgets/controls";
import { short } from "../widgets/numbers";

const words = (centre: Triple): string => centre.map((value) => short(value, 4)).join(", ");

export function CameraTable(props: {
  cameras: readonly SceneCamera[];
  selected: number | null;
  onSelect: (image: number) => void;
}) {
  return (
    <section class="scene" aria-label="Cameras">
      <p class="notice">This browser has no WebGL, so the cameras are listed in a table.</p>
      <ScrolledTable label="Positions of the cameras">
        <thead>
          <tr>
            <th scope="col">image</th>
            <th scope="col">centre before</th>
            <th scope="col">centre after</th>
            <th scope="col" class="number">
              turned °
            </th>
            <th scope="col" class="number">
              moved
            </th>
          </tr>
        </thead>
        <tbody>
          {props.cameras.map((camera, index) => (
            <tr key={index} aria-current={index === props.selected ? "true" : undefined}>
              <th scope="row">
                <button type="button" class="link" onClick={() => props.onSelect(index)}>
                  <bdi>{camera.name}</bdi>
                </button>
              </th>
              <td>{camera.before ? words(centreOf(camera.before)) : "–"}</td>
              <td>{words(centreOf(camera.after))}</td>
              <td class="number">{short(camera.moved_deg)}</td>
              <td class="number">{short(camera.moved_units)}</td>
            </tr>
          ))}
        </tbody>
      </ScrolledTable>
    </section>
  );
}
