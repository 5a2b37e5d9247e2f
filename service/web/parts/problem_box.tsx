// What went wrong, where, and what to do about it.
import type { JobError } from "schemas";
import type { Problem } from "../api/http";

export function ProblemBox({ problem, heading }: { problem: Problem | JobError; heading?: string }) {
  const title = heading ?? ("title" in problem ? problem.title : "It failed");
  return (
    <div class="problem" role="alert">
      <h3>{title}</h3>
      <p>{problem.detail}</p>
      {problem.where && (
        <p>
          Where: <code>{problem.where}</code>
        </p>
      )}
      {"errors" in problem && problem.errors.length > 0 && (
        <ul>
          {problem.errors.map((error) => (
            <li key={error.pointer + error.detail}>
              <code>{error.pointer}</code> {error.detail}
            </li>
          ))}
        </ul>
      )}
      {problem.hint && (
        <p>
          <strong>What to do:</strong> {problem.hint}
        </p>
      )}
      <p class="soft">
        Code <code>{problem.code}</code>
      </p>
    </div>
  );
}
