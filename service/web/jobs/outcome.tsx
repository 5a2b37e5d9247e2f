// An example result, for those who have no job yet: one view of the finished example.
import type { ViewFile } from "schemas";
import { address, requestJson } from "../api/http";
import { once, useLoaded } from "../api/hooks";

const SHOWN = [
  ["before", "given poses"],
  ["after", "refined poses"],
  ["photo", "photo"],
] as const;

export function Outcome() {
  const { value: view } = useLoaded((signal) => requestJson<ViewFile>("GET", "example/view.json", { signal }), once, []);
  const pictures = view?.views.find((one) => SHOWN.every(([kind]) => one.pictures[kind]))?.pictures;
  if (!pictures) return null;
  return (
    <section class="card outcome" aria-labelledby="outcome-heading">
      <h2 id="outcome-heading">Example result</h2>
      <p class="soft">
        A view that no training saw, rendered with the poses of the input and with the refined ones.{" "}
        <a href="#/example">See the whole result</a>
      </p>
      <div class="outcome-pictures">
        {SHOWN.map(([kind, words]) => (
          <figure key={kind}>
            <img src={address(`example/${pictures[kind]}`)} alt="" width={240} height={240} />
            <figcaption>{words}</figcaption>
          </figure>
        ))}
      </div>
    </section>
  );
}
