// A camera's view before and after refinement, and its photo against the field's render, difference and depth.
import { useMemo, useState } from "preact/hooks";
import type { ShownPictures, ShownView } from "schemas";
import { length, minus, type Triple } from "../result/poses";
import type { UrlOf } from "../result/widget_data";
import { Choice, ImageStepper, Slider } from "./controls";
import { fixed } from "./numbers";

interface ImageCompareProps {
  readonly names: readonly string[];
  readonly views: readonly ShownView[];
  /** Centres of the cameras, to find the nearest rendered views. */
  readonly centres: readonly Triple[];
  readonly urlOf: UrlOf;
  /** Whether the run was stopped before its end, where views are rendered. */
  readonly stopped?: boolean;
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
}

type PictureKind = keyof ShownPictures;
const MODES = [
  { value: "swipe", text: "photo | render" },
  { value: "refined", text: "test: given | refined" },
  { value: "difference", text: "difference" },
  { value: "depth", text: "depth" },
] as const;
type Mode = (typeof MODES)[number]["value"];
/** The two pictures of a swipe, left and right. */
const SWIPES = { refined: ["before", "after"], swipe: ["photo", "render"] } as const;
const WORDS = { photo: "Photo", render: "Render of", before: "Render with the given poses of", after: "Render with the refined poses of" };
/** As they stand on the pictures: the last two are of the verdict's short trainings, not of the result. */
const TAGS = { photo: "photo", render: "render", before: "given poses", after: "refined poses" };
const NEAR = 3;

export function ImageCompare({ names, views, centres, urlOf, stopped = false, selected, onSelect }: ImageCompareProps) {
  const [chosen, setMode] = useState<Mode>("swipe");
  const view = views.find((one) => one.image === selected);
  const modes = view?.pictures.before ? MODES : MODES.filter(({ value }) => value !== "refined");
  const mode = modes.some(({ value }) => value === chosen) ? chosen : "swipe";
  const shown = useMemo(() => views.map((one) => one.image).sort((a, b) => a - b), [views]);
  if (views.length === 0) {
    return (
      <section class="compare" aria-label="Render against photo">
        <p class="notice">{stopped ? "Views are rendered at the end of a run. This one was stopped before." : "No view of this result was rendered."}</p>
      </section>
    );
  }
  return (
    <section class="compare" aria-label="Render against photo">
      <div class="compare-controls">
        <Choice label="Show" value={mode} onChange={setMode} options={modes} />
      </div>
      {view ? (
        <Picture view={view} name={names[view.image] ?? ""} mode={mode} urlOf={urlOf} />
      ) : (
        <NotRendered {...{ names, shown, centres, selected, onSelect }} />
      )}
      <div class="compare-foot">
        <ImageStepper
          names={shown.map((image) => names[image] ?? "")}
          selected={view ? shown.indexOf(view.image) : null}
          onSelect={(position) => onSelect(position === null ? null : (shown[position] ?? null))}
        />
        <span class="soft">{shown.length === 1 ? "the only rendered view" : `of ${shown.length} rendered views`}</span>
      </div>
    </section>
  );
}

function Picture(props: { view: ShownView; name: string; mode: Mode; urlOf: ImageCompareProps["urlOf"] }) {
  const { view, name, mode, urlOf } = props;
  const [at, setAt] = useState(0.5);
  const [missing, setMissing] = useState<string | null>(null);
  const [left, right] = SWIPES[mode === "refined" ? "refined" : "swipe"];
  const frame = { aspectRatio: `${view.width} / ${view.height}`, maxWidth: `calc(max(62vh, 512px) * ${view.width / view.height})` };
  const picture = (kind: PictureKind, alt: string, style?: Record<string, string>) => {
    const file = view.pictures[kind];
    const source = file && urlOf(file);
    return !source ? (
      <p class="notice compare-missing">The {kind} is not in this file; it is in the folder of the result.</p>
    ) : (
      <img key={kind} src={source} alt={alt} style={style} draggable={false} onError={() => setMissing(kind)} />
    );
  };
  return (
    <figure class="compare-figure">
      {mode === "swipe" || mode === "refined" ? (
        <div class="compare-frame" style={frame}>
          {picture(right, `${WORDS[right]} ${name}`)}
          {picture(left, `${WORDS[left]} ${name}`, { clipPath: `inset(0 ${100 * (1 - at)}% 0 0)` })}
          <span class="compare-tag compare-left" aria-hidden="true">
            {TAGS[left]}
          </span>
          <span class="compare-tag compare-right" aria-hidden="true">
            {TAGS[right]}
          </span>
          <span class="compare-edge" style={{ left: `${100 * at}%` }} aria-hidden="true" />
          <Slider value={at} label={`Swipe between ${TAGS[left]} and ${TAGS[right]}`} text={`${Math.round(100 * at)} % ${TAGS[left]}`} onChange={setAt} />
        </div>
      ) : (
        <div class="compare-frame" style={frame}>
          {picture(mode, mode === "depth" ? `Depth at ${name}` : `Difference between photo and render at ${name}`)}
        </div>
      )}
      {missing && <p class="notice">The {missing} could not be loaded.</p>}
      <figcaption>
        {mode === "difference" && <Key left="equal" right="a quarter of the full range or more" />}
        {mode === "depth" && <Key left="far" right="near" />}
        {mode === "refined" ? (
          <span>The verdict's test: two short trainings, one with the given poses and one with the refined ones. Neither saw this view.</span>
        ) : (
          <span>
            PSNR <b>{fixed(view.psnr, 2)} dB</b> at {view.width} × {view.height} px,{" "}
            {view.held_out ? "a held-out view" : "a training view"}
          </span>
        )}
      </figcaption>
    </figure>
  );
}

function Key({ left, right }: { left: string; right: string }) {
  return (
    <span class="key">
      {left} <i class="key-ramp" /> {right}
    </span>
  );
}

function NotRendered(props: {
  names: readonly string[];
  shown: readonly number[];
  centres: readonly Triple[];
  selected: number | null;
  onSelect: (image: number) => void;
}) {
  const { names, shown, centres, selected, onSelect } = props;
  const here = selected === null ? undefined : centres[selected];
  const far = (image: number) => {
    const there = centres[image];
    return here && there ? length(minus(there, here)) : image;
  };
  const near = [...shown].sort((a, b) => far(a) - far(b)).slice(0, NEAR);
  return (
    <div class="notice">
      <p>
        {selected === null ? (
          "Select an image to see its render."
        ) : (
          <>
            <bdi>{names[selected]}</bdi> was not rendered: {shown.length} of {names.length} views were.
          </>
        )}
      </p>
      <p>
        {selected === null ? "Rendered views: " : "Nearest rendered views: "}
        {near.map((image, position) => (
          <>
            {position > 0 && ", "}
            <button type="button" class="link" onClick={() => onSelect(image)}>
              <bdi>{names[image]}</bdi>
            </button>
          </>
        ))}
      </p>
    </div>
  );
}
