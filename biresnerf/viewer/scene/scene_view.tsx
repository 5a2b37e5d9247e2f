// Cameras before and after, in three dimensions; a table takes their place if the browser has no WebGL.
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { between, centreOf, medianOf, spreadOf, turnDeg } from "../result/poses";
import type { PointLayer, SceneCamera, SheetCell } from "../result/widget_data";
import { Button, ImageStepper, Slider } from "../widgets/controls";
import { fixed, short } from "../widgets/numbers";
import { themeColour, useDark, useReducedMotion } from "../widgets/theme";
import { sourceWords } from "../widgets/words";
import { CameraTable } from "./camera_table";
import { colourOf, coloursOf, hexColour, kindsOf } from "./colours";
import { exaggerationOf } from "./ellipsoids";
import type { Look } from "./geometry";
import { capOf, FIRST_CHOICE, layerOf, Legend, SceneControls } from "./scene_controls";
import { useScene } from "./use_scene";

interface SceneViewProps {
  readonly cameras: readonly SceneCamera[];
  readonly points?: readonly PointLayer[];
  /** Index of the selected image. */
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
  /** Where a photo lies in the contact sheet, to show it in its frustum. */
  readonly cellOf?: (image: number) => SheetCell | null;
  /** A photo's own picture, larger than that, if there is one. */
  readonly photoOf?: (image: number) => string | null;
}

const NO_POINTS: readonly PointLayer[] = [];
const NONE = () => null;

export function SceneView(props: SceneViewProps) {
  const { cameras, points = NO_POINTS, selected, onSelect, cellOf = NONE, photoOf = NONE } = props;
  const [dark, still] = [useDark(), useReducedMotion()];
  const [share, setShare] = useState(1);
  const [choice, setChoice] = useState(FIRST_CHOICE);
  const [through, setThrough] = useState(false);
  const [overlay, setOverlay] = useState(0.5);
  const compared = useMemo(() => cameras.some(({ before }) => before !== null), [cameras]);
  const pictured = cameras.length > 0 && cellOf(0) !== null;
  const host = useRef<HTMLDivElement>(null);

  const spread = useMemo(() => {
    const centres = cameras.map((camera) => centreOf(camera.after));
    return spreadOf(centres, medianOf(centres));
  }, [cameras]);
  const offered = useMemo(() => coloursOf(cameras), [cameras]);
  const by = offered.includes(choice.by) ? choice.by : offered[0];
  const kinds = useMemo(() => kindsOf(cameras, by), [cameras, by]);
  const cap = capOf(choice, by, spread);
  const painted = useMemo(
    () => ({
      colours: cameras.map((camera) => colourOf(camera, by, cap, kinds, dark)),
      gridColour: hexColour(themeColour("--line-strong")),
      beforeColour: hexColour(themeColour("--before")),
      selectedColour: hexColour(themeColour("--accent")),
    }),
    [cameras, by, cap, kinds, dark],
  );
  const layer = layerOf(points, choice.layer);
  const { lines, before, photos } = choice;
  const times = useMemo(() => {
    const some = cameras.some((camera) => camera.uncertainty?.position != null);
    return some ? exaggerationOf(cameras, spread / Math.sqrt(Math.max(4, cameras.length))) : null;
  }, [cameras, spread]);
  const exaggerated = choice.uncertainty ? (times ?? 0) : 0;
  const look = useMemo<Look>(
    () => ({ ...painted, lines, before, layer, share, selected, exaggerated, photos, cellOf, photoOf, overlay }),
    [painted, lines, before, layer, share, selected, exaggerated, photos, cellOf, photoOf, overlay],
  );
  const { drawing, failed } = useScene(host, cameras, look, () => setThrough(false));
  useEffect(() => {
    if (through && selected !== null) drawing.current?.lookThrough(selected, !still);
  }, [through, selected, still]);
  const back = () => {
    setThrough(false);
    drawing.current?.overview(!still);
  };

  if (failed !== null) return <CameraTable cameras={cameras} selected={selected} onSelect={onSelect} />;
  const chosen = selected === null ? undefined : cameras[selected];
  return (
    <section class="scene" aria-label="Cameras in three dimensions">
      <SceneControls
        {...{ choice, points, by, spread, compared, pictured }}
        colours={offered}
        exaggerated={times}
        onChange={(changed) => setChoice({ ...choice, ...changed })}
      />
      <div
        class="scene-stage"
        ref={host}
        role="application"
        tabIndex={0}
        aria-label={`Picture of ${cameras.length} cameras. Left and right arrow keys select a camera, Enter looks through it, Escape goes back.`}
        onPointerDown={(event) => pressed.set(event)}
        onClick={(event) => {
          const found = pressed.moved(event) ? null : drawing.current?.pick(event.clientX, event.clientY);
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
        <Legend {...{ by, cap, kinds, dark }} unknown={cameras.some((camera) => camera[by] === null)} />
      </div>
      {compared && (
        <label class="scene-slider">
          <span>Input</span>
          <Slider
            value={share}
            label="From the input's poses to the refined ones"
            text={share === 0 ? "input" : share === 1 ? "refined" : `${Math.round(100 * share)} % of the way`}
            onChange={setShare}
          />
          <span>Refined</span>
        </label>
      )}
      {through && pictured && (
        <label class="scene-slider">
          <span>Points</span>
          <Slider value={overlay} label="Photo over the view" text={`${Math.round(100 * overlay)} % photo`} onChange={setOverlay} />
          <span>Photo</span>
        </label>
      )}
      <div class="scene-foot">
        <ImageStepper names={cameras.map((camera) => camera.name)} selected={selected} onSelect={onSelect} />
        <Button disabled={!chosen} pressed={through} onClick={() => (through ? back() : setThrough(true))}>
          Look through
        </Button>
        <Button onClick={back}>Overview</Button>
        {chosen && <Readout camera={chosen} share={share} />}
      </div>
    </section>
  );
}

/** A press that ends elsewhere has rotated the scene and selects nothing. */
const pressed = {
  x: 0,
  y: 0,
  set(event: PointerEvent) {
    [this.x, this.y] = [event.clientX, event.clientY];
  },
  moved(event: MouseEvent): boolean {
    return Math.hypot(event.clientX - this.x, event.clientY - this.y) > 4;
  },
};

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
      {camera.uncertainty && (
        <div>
          <dt>exact to (90 %)</dt>
          <dd>
            {camera.uncertainty.why_unknown ??
              `± ${short(camera.uncertainty.rotation_deg)}°, ± ${short(camera.uncertainty.position)} units, from ${camera.uncertainty.known_from}`}
          </dd>
        </div>
      )}
      <div>
        <dt>pose from</dt>
        <dd>{sourceWords(camera.source)}</dd>
      </div>
    </dl>
  );
}
