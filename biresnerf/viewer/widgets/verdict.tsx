// The verdict in one sentence, and its evidence.
import type { PairedDifference, Report, Verdict } from "schemas";
import { VerdictChip } from "./controls";
import { count, fixed, short, signed } from "./numbers";

export function VerdictSentence({ report }: { report: Report }) {
  const { verdict, state, options } = report;
  return (
    <p class="verdict-sentence">
      {verdict ? (
        <>
          <VerdictChip verdict={verdict.verdict} /> {verdict.why[0]} {returnedWords(verdict)}
        </>
      ) : (
        <>
          <span class="chip chip-plain">{state === "partial" ? "partial result" : "no verdict"}</span>
          {state === "partial"
            ? stoppedWords(report)
            : options.verdict === false
              ? "No verdict was requested: the result holds the refined poses."
              : "No verdict was reached."}
        </>
      )}
    </p>
  );
}

const WHOSE = { given: "your own poses", seeded: "the poses from feature matches", mixed: "the poses it started from" };

/** Which poses are in the downloads. */
function returnedWords({ returned, compared_with }: Verdict): string {
  if (returned === "refined") return "The downloads contain the refined poses.";
  return `The downloads contain ${WHOSE[compared_with]}; the refined ones are in refined/.`;
}

/** Where a run was stopped, and what that means for its poses and the verdict. */
function stoppedWords({ steps_done, options, verdict_so_far }: Report): string {
  return [
    `The run was stopped ${stepWords(steps_done, Number(options.steps))}.`,
    soFarWords(verdict_so_far),
    "There is no verdict: the test on photos that were held back comes at the end of a run.",
    verdict_so_far?.why[0],
  ]
    .filter(Boolean)
    .join(" ");
}

function stepWords(done: number, all: number): string {
  if (done === 0) return "before its first step";
  return done < all ? `at step ${done.toLocaleString("en-GB")} of ${all.toLocaleString("en-GB")}` : "after its last step, before its end";
}

/** Which poses are in the downloads of a stopped run. */
function soFarWords(verdict: Verdict | null): string {
  if (!verdict) return "The downloads contain its latest poses. They are not final, and were not compared with the input's.";
  if (verdict.returned === "input") return `The downloads contain ${WHOSE[verdict.compared_with]}: no better ones were found until then.`;
  return "The downloads contain the best poses until then, which are not final.";
}

/** The two measurements behind a verdict, folded away. */
export function Evidence({ verdict }: { verdict: Verdict | null }) {
  if (!verdict) return null;
  const { heldout, epipolar } = verdict;
  return (
    <details class="evidence">
      <summary>How this was measured</summary>
      <div class="proofs">
        {heldout && (
          <Measurement
            title={`Before and after: PSNR of ${count(heldout.psnr.count, "unseen view")}`}
            difference={heldout.psnr}
            gain={`${signed(heldout.psnr.difference, 2)} dB`}
            ends={(value) => `${signed(value, 2)} dB`}
            before={fixed(heldout.psnr.before, 2)}
            after={`${fixed(heldout.psnr.after, 2)} dB`}
            least={0.5}
            note={`Two identical models were trained for ${count(heldout.steps, "step")}, one with each set of poses held fixed.`}
          />
        )}
        {epipolar && (
          <Measurement
            title={`Before and after: matching error of ${count(epipolar.matches, "feature match", "feature matches")}`}
            difference={epipolar.error_px}
            gain={timesWords(epipolar.error_px.difference)}
            ends={timesWords}
            before={short(epipolar.error_px.before)}
            after={`${short(epipolar.error_px.after)} px`}
            least={0.1}
            note={
              epipolar.independent
                ? "No pose was estimated from these matches."
                : "The initial poses came from these matches, so they count only as a warning, not as proof."
            }
          />
        )}
        {!heldout && !epipolar && <p class="soft">The scene's middle moved by {short(verdict.moved_px)} px in the photos (median).</p>}
      </div>
    </details>
  );
}

/** A ratio given as its logarithm to base 2. */
function timesWords(octaves: number): string {
  const times = short(2 ** Math.abs(octaves), 2);
  return `${times} times ${octaves < 0 ? "larger" : "smaller"}`;
}

const FINDING: Readonly<Record<PairedDifference["finding"], string>> = {
  better: "better",
  worse: "worse",
  same: "the same",
  open: "not certain",
};

function Measurement(props: {
  title: string;
  difference: PairedDifference;
  gain: string;
  ends: (value: number) => string;
  before: string;
  after: string;
  least: number;
  note: string;
}) {
  const { difference: d, ends } = props;
  const interval = d.low !== null && d.high !== null ? ` (95 % interval: ${ends(d.low)} to ${ends(d.high)})` : "";
  const words = `${props.gain}${interval}`;
  return (
    <div class="proof">
      <div class="proof-title">{props.title}</div>
      <div class="proof-figures">
        <span>
          {props.before} → <b>{props.after}</b>
        </span>
        <span class={`proof-finding proof-${d.finding}`}>{FINDING[d.finding]}</span>
      </div>
      <Interval difference={d} least={props.least} label={words} />
      <div class="soft">
        {words}. {props.note}
      </div>
    </div>
  );
}

const WIDTH = 260;
const HEIGHT = 26;

/** The difference with its interval on an axis: better to the right; within the grey band it is negligible. */
function Interval({ difference: d, least, label }: { difference: PairedDifference; least: number; label: string }) {
  const ends = [d.difference, d.low ?? d.difference, d.high ?? d.difference];
  const reach = 1.15 * Math.max(2 * least, ...ends.map(Math.abs));
  const x = (value: number) => WIDTH / 2 + (value / reach) * (WIDTH / 2 - 6);
  return (
    <svg class="interval" viewBox={`0 0 ${WIDTH} ${HEIGHT}`} preserveAspectRatio="xMinYMid" role="img" aria-label={label}>
      <rect class="interval-band" x={x(-least)} width={x(least) - x(-least)} y={3} height={HEIGHT - 6} rx={2} />
      <line class="interval-axis" x1={0} x2={WIDTH} y1={HEIGHT / 2} y2={HEIGHT / 2} />
      <line class="interval-zero" x1={x(0)} x2={x(0)} y1={2} y2={HEIGHT - 2} />
      {d.low !== null && d.high !== null && (
        <line class={`interval-range interval-${d.finding}`} x1={x(d.low)} x2={x(d.high)} y1={HEIGHT / 2} y2={HEIGHT / 2} />
      )}
      <circle class={`interval-dot interval-${d.finding}`} cx={x(d.difference)} cy={HEIGHT / 2} r={4.5} />
    </svg>
  );
}
