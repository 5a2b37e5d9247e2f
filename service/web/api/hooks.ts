// What components load from the service or ask of it, and what went wrong.
import { useEffect, useState } from "preact/hooks";
import { asProblem, pause, type Problem } from "./http";

/**
 * What `load` returns. It is loaded again after the milliseconds that `again` returns, never after null, and not while
 * the page is hidden.
 */
export function useLoaded<T>(
  load: (signal: AbortSignal) => Promise<T>,
  again: (value: T) => number | null,
  inputs: readonly unknown[],
): { value: T | null; problem: Problem | null } {
  const [value, setValue] = useState<T | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    const stop = new AbortController();
    void (async () => {
      for (let wait: number | null = 0; wait !== null; ) {
        await pause(wait);
        await visible();
        if (stop.signal.aborted) return;
        try {
          const loaded = await load(stop.signal);
          if (stop.signal.aborted) return;
          setValue(loaded);
          setProblem(null);
          wait = again(loaded);
        } catch (error) {
          if (stop.signal.aborted) return;
          const failure = asProblem(error);
          setProblem(failure);
          wait = failure.transient ? failure.pauseMs : null;
        }
      }
    })();
    return () => stop.abort();
  }, inputs);
  return { value, problem };
}

/** For `useLoaded`: once is enough. */
export const once = () => null;

async function visible(): Promise<void> {
  while (document.hidden) {
    await new Promise((shown) => document.addEventListener("visibilitychange", shown, { once: true }));
  }
}

export interface Attempt {
  /** Runs an action, one at a time; returns whether it succeeded. */
  attempt: (action: () => Promise<void>) => Promise<boolean>;
  busy: boolean;
  problem: Problem | null;
}

/** An action that the user starts. */
export function useAttempt(): Attempt {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const attempt = async (action: () => Promise<void>) => {
    setBusy(true);
    setProblem(null);
    try {
      await action();
      return true;
    } catch (error) {
      setProblem(asProblem(error));
      return false;
    } finally {
      setBusy(false);
    }
  };
  return { attempt, busy, problem };
}
