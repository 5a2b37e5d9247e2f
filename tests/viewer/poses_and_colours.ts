// Answers what test_poses_and_colours.py asks: reads questions as JSON from standard input, writes the answers.
import { readFileSync } from "node:fs";
import { rampColour } from "../../biresnerf/viewer/scene/colours";
import { historyOf, pointsOf } from "../../biresnerf/viewer/result/widget_data";
import { between, bordersOf, turnDeg } from "../../biresnerf/viewer/result/poses";

const asked = JSON.parse(readFileSync(0, "utf-8"));
const bytes = Uint8Array.from(Buffer.from(asked.points.base64, "base64")).buffer;
const layer = pointsOf(asked.points.entry, bytes);
process.stdout.write(
  JSON.stringify({
    between: asked.pairs.map(([a, b, share]) => between(a, b, share)),
    turned: asked.pairs.map(([a, b]) => turnDeg(a, b)),
    ramp: asked.values.map((value) => [rampColour(value, false), rampColour(value, true)]),
    borders: asked.cameras.map(bordersOf),
    history: historyOf(asked.history),
    points: { positions: [...layer.positions], colours: [...layer.colours] },
  }),
);
