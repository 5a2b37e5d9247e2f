// Tells of jobs that ended, by the browser's notifications, while the user looks elsewhere.
import { useState } from "preact/hooks";
import type { JobView } from "schemas";
import { VERDICTS } from "../../../biresnerf/viewer/widgets/words";
import { isOver, STATE_WORDS, titleOf } from "../jobs/state";

const ITEM = "biresnerf-notify";
const possible = () => "Notification" in globalThis; // not on HTTP, but for localhost
const wanted = () => possible() && Notification.permission === "granted" && localStorage.getItem(ITEM) === "on";

/** Turns notifications on and off; nothing where the browser has none. */
export function NotifySwitch() {
  const [on, setOn] = useState(wanted);
  const [refused, setRefused] = useState(false);
  if (!possible()) return null;
  const turn = async (next: boolean) => {
    const allowed = next && (await Notification.requestPermission()) === "granted";
    setRefused(next && !allowed);
    localStorage.setItem(ITEM, allowed ? "on" : "off");
    setOn(allowed);
  };
  return (
    <label class="switch notify">
      <input type="checkbox" checked={on} onChange={(event) => void turn(event.currentTarget.checked)} />
      <span>{refused ? "This browser blocks notifications" : "Notify me when it ends"}</span>
    </label>
  );
}

/** Notifies of jobs that were going before and are over now. */
export function notifyOfEnds(before: readonly JobView[], now: readonly JobView[]): void {
  if (!wanted() || document.hasFocus()) return;
  const going = new Set(before.filter((job) => !isOver(job)).map(({ id }) => id));
  for (const job of now) {
    if (!going.has(job.id) || !isOver(job)) continue;
    const words = job.state === "succeeded" && job.verdict ? VERDICTS[job.verdict].word : STATE_WORDS[job.state];
    const shown = new Notification(`${titleOf(job)}: ${words}`, { tag: job.id });
    shown.onclick = () => {
      focus();
      location.hash = `#/jobs/${job.id}`;
    };
  }
}
