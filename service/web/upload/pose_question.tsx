// The question whether given poses mean something else than their format says, and the answer as an option.
import type { PoseQuestion } from "schemas";
import type { Values } from "../options/schema";

/** Whether the options answer it with yes. */
export function answeredYes(question: PoseQuestion | null | undefined, values: Values): boolean {
  const chosen = Array.isArray(values.given_poses) ? values.given_poses.map(String) : [];
  return !!question && [...chosen].sort().join() === [...question.given_poses].sort().join();
}

interface Props {
  question: PoseQuestion;
  yes: boolean;
  onAnswer: (yes: boolean) => void;
}

export function AskedPoses({ question, yes, onAnswer }: Props) {
  return (
    <section class="card" aria-labelledby="pose-question">
      <h2 id="pose-question">Convert the poses?</h2>
      <p>{question.question}</p>
      <p class="submit">
        <button type="button" class="act" aria-pressed={yes} onClick={() => onAnswer(!yes)}>
          Convert
        </button>
        <span class="soft" role="status">
          {yes ? "The job converts them; the cameras below are shown converted." : "They are used unchanged."}
        </span>
      </p>
    </section>
  );
}
