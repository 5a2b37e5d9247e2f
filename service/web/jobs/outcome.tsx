// An example result, for those who have no job yet: one view by two fields, and its photo.
import { address } from "../api/http";

// Two fields learned equally long, one from the given poses and one from the refined ones.
const SHOWN = [
  ["given", "given poses"],
  ["refined", "refined poses"],
  ["photo", "photo"],
] as const;

export function Outcome() {
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
            <img src={address(`example/unseen/${kind}.jpg`)} alt="" width={240} height={240} />
            <figcaption>{words}</figcaption>
          </figure>
        ))}
      </div>
    </section>
  );
}
