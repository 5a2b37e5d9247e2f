// (1) Cameras before and after, in three dimensions.
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { colourOf, css, kindColour, rampColour, scaleOf, signedColour, UNKNOWN } from "./colours";
import { Choice, ImageStepper, Pick, Switch } from "./Controls";
import { fixed, short, sourceWords } from "./numbers";
import { between, centreOf, medianOf, spreadOf, turnDeg } from "./poses";
import { SceneDrawing } from "./scene_drawing";
import type { Look, Viewpoint } from "./scene_parts";
import { CameraTable } from "./CameraTable";
import { hexColour, themeColour, useDark, useStill } from "./theme";
import type { ColourBy, PointLayer, SceneCamera, SceneViewProps } from "./types";

const LAYER_WORDS: Readonly<Record<PointLayer["source"], string>> = {
  given: "the input's points",
  features: "feature matches",
  tracks: "the input's tracks",
  moved: "the input's points, moved",
  field: "surface in the field",
};
const NO_POINTS: readonly PointLayer[] = [];

export function SceneView({ cameras, points = NO_POINTS, selected, onSelect }: SceneViewProps) {
  const dark = useDark();
  const still = useStill();
  const [share, setShare] = useState(1);
  const [lines, setLines] = useState<0 | 1 | 10>(1);
  const [before, setBefore] = useState(true);
  const [by, setBy] = useState<ColourBy>("moved_deg");
  const [caps, setCaps] = useState<Partial<Record<ColourBy, number>>>({});
  const [chosenLayer, setLayer] = useState<string | null>(null);
  const layer = chosenLayer ?? bestLayer(points); // points may come later than the cameras
  const [through, setThrough] = useState(false);
  const [failed, setFailed] = useState<string | null>(null);
  const host = useRef<HTMLDivElement>(null);
  const drawing = useRef<SceneDrawing | null>(null);
  const seenFrom = useRef<Viewpoint | null>(null); // kept while a run's cameras move on

  const spread = useMemo(() => {
    const centres = cameras.map((camera) => centreOf(camera.after));
    return spreadOf(centres, medianOf(centres));
  }, [cameras]);
  const scale = useMemo(() => scaleOf(by, spread), [by, spread]);
  const cap = caps[by] ?? scale.caps[0] ?? 1;
  const kinds = useMemo(() => [...new Set(cameras.map((camera) => camera.source))].sort(), [cameras]);
  const look = useMemo<Omit<Look, "share" | "selected">>(
    () => ({
      lines,
      before,
      colours: cameras.map((camera) => colourOf(camera, by, cap, kinds, dark)),
      beforeColour: hexColour(themeColour("--before")),
      selectedColour: hexColour(themeColour("--accent")),
      layer: points.find((one) => one.source === layer) ?? null,
    }),
    [cameras, points, lines, before, by, cap, kinds, dark, layer],
  );

  useEffect(() => {
    if (!host.current) return;
    let made: SceneDrawing;
    try {
      made = new SceneDrawing(host.current, cameras, () => setThrough(false));
    } catch (error) {
      setFailed(error instanceof Error ? error.message : String(error));
      return;
    }
    drawing.current = made;
    if (seenFrom.current) made.seeFrom(seenFrom.current);
    const observer = new ResizeObserver(([entry]) => {
      if (entry) made.resize(entry.contentRect.width, entry.contentRect.height);
    });
    observer.observe(host.current);
    return () => {
      observer.disconnect();
      seenFrom.current = made.viewpoint();
      made.dispose();
      drawing.current = null;
    };
  }, [cameras]);

  useEffect(() => {
    const now = drawing.current;
    if (!now) return;
    now.show({ ...look, share, selected });
    tellTruth(host.current, now, selected, share);
  }, [cameras, look, share, selected]);

  useEffect(() => {
    if (through && selected !== null) drawing.current?.lookThrough(selected, !still);
  }, [through, selected, still]);

  const chosen = selected === null ? undefined : cameras[selected];
  if (failed !== null) return <CameraTable cameras={cameras} selected={selected} onSelect={onSelect} />;
  return (
    <section class="scene" aria-label="Cameras in three dimensions">
      <div class="scene-controls">
        <Pick label="Colour" value={by} onChange={setBy} options={COLOUR_OPTIONS} />
        {scale.caps.length > 0 && (
          <Pick
            label="up to"
            value={cap}
            onChange={(value) => setCaps({ ...caps, [by]: value })}
            options={[...scale.caps].sort((a, b) => a - b).map((value) => ({ value, text: `${value} ${scale.unit}` }))}
          />
        )}
        <Choice
          label="Lines"
          value={lines}
          onChange={setLines}
          options={[
            { value: 0, text: "off" },
            { value: 1, text: "×1" },
            { value: 10, text: "×10" },
          ]}
        />
        {points.length > 0 && (
          <Pick
            label="Points"
            value={layer}
            onChange={setLayer}
            options={[
              { value: "", text: "none" },
              ...points.map((one) => ({ value: one.source, text: LAYER_WORDS[one.source] })),
            ]}
          />
        )}
        <Switch label="Input" on={before} onChange={setBefore} />
      </div>
      <div
        class="scene-stage"
        ref={host}
        role="application"
        tabIndex={0}
        aria-label={`Picture of ${cameras.length} cameras. Left and right arrow keys choose a camera, Enter looks through it, Escape goes back.`}
        onPointerDown={(event) => press.set(event)}
        onClick={(event) => {
          if (press.moved(event)) return;
          const found = drawing.current?.pick(event.clientX, event.clientY);
          if (found !== undefined && found !== null) onSelect(found);
        }}
        onKeyDown={(event) => {
          const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
          if (step !== undefined) onSelect(((selected ?? (step > 0 ? -1 : 0)) + step + cameras.length) % cameras.length);
          else if (event.key === "Enter" && selected !== null) setThrough(true);
          else if (event.key === "Escape") back();
          else return;
          event.preventDefault();
        }}
      >
        <Legend by={by} cap={cap} kinds={kinds} dark={dark} unknown={cameras.some((c) => c.delta_psnr === null)} />
      </div>
      <label class="scene-slider">
        <span>Input</span>
        <input
          type="range"
          min={0}
          max={1}
          step={0.01}
          value={share}
          aria-label="From the input's poses to the refined ones"
          aria-valuetext={share === 0 ? "input" : share === 1 ? "refined" : `${Math.round(100 * share)} % of the way`}
          onInput={(event) => setShare(Number(event.currentTarget.value))}
        />
        <span>Refined</span>
      </label>
      <div class="scene-foot">
        <ImageStepper names={cameras.map((camera) => camera.name)} selected={selected} onSelect={onSelect} />
        <button type="button" class="button" disabled={!chosen} aria-pressed={through} onClick={() => (through ? back() : setThrough(true))}>
          Look through
        </button>
        <button type="button" class="button" onClick={back}>
          Overview
        </button>
        {chosen && <Readout camera={chosen} share={share} />}
      </div>
    </section>
  );

  function back() {
    setThrough(false);
    drawing.current?.overview(!still);
  }
}

const COLOUR_OPTIONS: readonly { value: ColourBy; text: string }[] = [
  { value: "moved_deg", text: "turned (°)" },
  { value: "moved_units", text: "moved (units)" },
  { value: "delta_psnr", text: "PSNR gain (dB)" },
  { value: "source", text: "where the pose is from" },
];

const bestLayer = (points: readonly PointLayer[]): string =>
  (points.find((layer) => layer.source === "field") ?? points[0])?.source ?? "";

/** A press that ends elsewhere turned the scene, and chooses nothing. */
const press = {
  x: 0,
  y: 0,
  set(event: PointerEvent) {
    [this.x, this.y] = [event.clientX, event.clientY];
  },
  moved(event: MouseEvent): boolean {
    return Math.hypot(event.clientX - this.x, event.clientY - this.y) > 4;
  },
};

/** What is really drawn of the chosen camera, for whoever checks the picture. */
function tellTruth(stage: HTMLElement | null, now: SceneDrawing, selected: number | null, share: number) {
  if (!stage) return;
  stage.dataset.share = String(share);
  stage.dataset.selected = selected === null ? "" : String(selected);
  stage.dataset.centre = selected === null ? "" : now.drawnCentre(selected).join(" ");
  stage.dataset.onScreen = selected === null ? "" : (now.onScreen(selected, 0) ?? []).join(" ");
}

function Readout({ camera, share }: { camera: SceneCamera; share: number }) {
  const pose = camera.before ? between(camera.before, camera.after, share) : camera.after;
  return (
    <dl class="readout">
      <div>
        <dt>centre</dt>
        <dd>{centreOf(pose).map((value) => short(value, 4)).join(", ")}</dd>
      </div>
      <div>
        <dt>turned</dt>
        <dd>{camera.before ? `${fixed(turnDeg(camera.before, pose), 2)}°` : "no input pose"}</dd>
      </div>
      <div>
        <dt>moved</dt>
        <dd>{short(camera.moved_units * share)} units</dd>
      </div>
      <div>
        <dt>pose from</dt>
        <dd>{sourceWords(camera.source)}</dd>
      </div>
    </dl>
  );
}

function Legend(props: { by: ColourBy; cap: number; kinds: readonly string[]; dark: boolean; unknown: boolean }) {
  const { by, cap, kinds, dark } = props;
  const scale = scaleOf(by, 1);
  if (by === "source") {
    return (
      <ul class="legend">
        {kinds.map((kind) => (
          <li key={kind}>
            <i style={{ background: css(kindColour(kind, kinds)) }} /> {sourceWords(kind)}
          </li>
        ))}
      </ul>
    );
  }
  const stops = Array.from({ length: 17 }, (_, i) => i / 16);
  const colours = stops.map((at) => css(scale.signed ? signedColour(2 * at - 1, dark) : rampColour(at, dark)));
  return (
    <div class="legend">
      <span class="legend-title">
        {scale.label} ({scale.unit})
      </span>
      <span class="legend-ramp" style={{ background: `linear-gradient(to right, ${colours.join(", ")})` }} />
      <span class="legend-ends">
        <span>{scale.signed ? `≤ −${cap}` : "0"}</span>
        <span>≥ {cap}</span>
      </span>
      {by === "delta_psnr" && props.unknown && (
        <span class="legend-note">
          <i style={{ background: css(UNKNOWN) }} /> not measured
        </span>
      )}
    </div>
  );
}
