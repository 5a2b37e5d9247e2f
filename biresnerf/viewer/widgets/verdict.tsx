// The verdict in one sentence, with its evidence.
import type { PairedDifference, Verdict } from "schemas";
import { VerdictChip } from "./controls";
import { count, fixed, short, signed } from "./numbers";

interface VerdictSentenceProps {
  readonly verdict: Verdict | null;
  readonly state: "complete" | "partial";
  /** Whether the options request a verdict. */
  readonly requested?: boolean;
}

export function VerdictSentence({ verdict, state, requested = true }: VerdictSentenceProps) {
  if (!verdict) {
    return (
      <section class="verdict" aria-label="Verdict">
        <p class="verdict-sentence">
          <span class="chip chip-plain">{state === "partial" ? "partial" : "no verdict"}</span>
          {state === "partial"
            ? "The run was stopped early: these are the best poses so far. They were not compared with the input's."
            : requested
              ? "No verdict was reached."
              : "No verdict was requested: the result holds the refined poses."}
        </p>
      </section>
    );
  }
  return (
    <section class="verdict" aria-label="Verdict">
      <p class="verdict-sentence">
        <VerdictChip verdict={verdict.verdict} />
        {verdict.why[0]} {RETURNED[verdict.returned]}
      </p>
      <div class="proofs">
        {verdict.heldout && (
          <Evidence
            title={`${count(verdict.heldout.psnr.count, "unseen view")}, PSNR`}
            difference={verdict.heldout.psnr}
            unit="dB"
            before={fixed(verdict.heldout.psnr.before, 2)}
            after={fixed(verdict.heldout.psnr.after, 2)}
            least={0.5}
            note={`Two equal trainings of ${count(verdict.heldout.steps, "step")} with fixed poses.`}
          />
        )}
        {verdict.epipolar && (
          <Evidence
            title={`${count(verdict.epipolar.matches, "feature match", "feature matches")}, epipolar error`}
            difference={verdict.epipolar.error_px}
            unit="octaves"
            before={`${short(verdict.epipolar.error_px.before)} px`}
            after={`${short(verdict.epipolar.error_px.after)} px`}
            least={0.1}
            note={
              verdict.epipolar.independent
                ? "These matches had no part in the initial poses; one octave halves the error."
                : "The initial poses came from these matches, so they count only against the refined poses."
            }
          />
        )}
        {!verdict.heldout && !verdict.epipolar && (
          <p class="soft">The scene's middle moved by {short(verdict.moved_px)} px in the photos (median).</p>
        )}
      </div>
    </section>
  );
}

const RETURNED: Readonly<Record<Verdict["returned"], string>> = {
  refined: "The result holds the refined poses.",
  input: "The result holds the input's poses; refined/ has the refined ones.",
};

const FINDING: Readonly<Record<PairedDifference["finding"], string>> = {
  better: "better",
  worse: "worse",
  same: "the same",
  open: "not certain",
};

function Evidence(props: {
  title: string;
  difference: PairedDifference;
  unit: string;
  before: string;
  after: string;
  least: number;
  note: string;
}) {
  const { difference: d, unit } = props;
  return (
    <div class="proof">
      <div class="proof-title">{props.title}</div>
      <div class="proof-figures">
        <span>
          {props.before} → <b>{props.after}</b>
        </span>
        <span class={`proof-finding proof-${d.finding}`}>{FINDING[d.finding]}</span>
      </div>
      <Interval difference={d} least={props.least} unit={unit} />
      <div class="soft">
        gain {gainOf(d, unit)}. {props.note}
      </div>
    </div>
  );
}

function gainOf({ difference, low, high }: PairedDifference, unit: string): string {
  const interval = low !== null && high !== null ? `, 95 % interval ${signed(low, 2)} to ${signed(high, 2)}` : "";
  return `${signed(difference, 2)} ${unit}${interval}`;
}

const WIDTH = 260;
const HEIGHT = 26;

/** The difference with its interval on an axis; differences within the grey band are negligible. */
function Interval({ difference: d, least, unit }: { difference: PairedDifference; least: number; unit: string }) {
  const ends = [d.difference, d.low ?? d.difference, d.high ?? d.difference];
  const reach = 1.15 * Math.max(2 * least, ...ends.map(Math.abs));
  const x = (value: number) => WIDTH / 2 + (value / reach) * (WIDTH / 2 - 6);
  return (
    <svg class="interval" viewBox={`0 0 ${WIDTH} ${HEIGHT}`} preserveAspectRatio="xMinYMid" role="img" aria-label={`Gain ${gainOf(d, unit)}`}>
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
