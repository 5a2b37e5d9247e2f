// What went wrong, where, and what to do about it.
import type { JobError } from "schemas";
import { optionTitle, worded } from "../../../biresnerf/viewer/widgets/option_words";
import type { Problem } from "../api/http";

export function ProblemBox({ problem, heading }: { problem: Problem | JobError; heading?: string }) {
  const title = heading ?? ("title" in problem ? problem.title : "It failed");
  return (
    <div class="problem" role="alert">
      <h3>{title}</h3>
      <p>{worded(problem.detail)}</p>
      {problem.where && (
        <p>
          Where: <code>{problem.where}</code>
        </p>
      )}
      {"errors" in problem && problem.errors.length > 0 && (
        <ul>
          {problem.errors.map((error) => (
            <li key={error.pointer + error.detail}>
              <strong>{placeOf(error.pointer)}</strong>: {worded(error.detail)}
            </li>
          ))}
        </ul>
      )}
      {problem.hint && (
        <p>
          <strong>What to do:</strong> {worded(problem.hint)}
        </p>
      )}
      <details class="error-code soft">
        <summary>Code of this error</summary>
        <code>{problem.code}</code>
      </details>
    </div>
  );
}

/** The field that a JSON pointer leads to. */
const placeOf = (pointer: string): string => optionTitle(pointer.slice(pointer.lastIndexOf("/") + 1)).replaceAll("_", " ");
