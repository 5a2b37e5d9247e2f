// The dialog in which a user masks parts of one photo. It is loaded when the first one is opened.
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { Choice, Slider, Switch } from "../../../biresnerf/viewer/widgets/controls";
import { count } from "../../../biresnerf/viewer/widgets/numbers";
import { once, useLoaded } from "../api/hooks";
import { request } from "../api/http";
import { ProblemBox } from "../parts/problem_box";
import { Mask, type Place } from "./mask";
import { Stage, type Tool } from "./stage";

const TOOLS: { value: Tool; text: string }[] = [
  { value: "paint", text: "Paint" },
  { value: "erase", text: "Erase" },
  { value: "fill", text: "Fill by colour" },
];
const UNDONE_MAX = 20;
/** The service refuses a photo of which less counts. */
const COUNTING_MIN = 1e-3;

interface Props {
  name: string;
  /** Of the photo in the API. */
  path: string;
  /** Whether the service has a mask of it. */
  masked: boolean;
  /** What was painted before and is not saved yet. */
  painted: Mask | null;
  /** How many other photos have the same size. */
  others: number;
  onDone: (mask: Mask, everywhere: boolean) => void;
  onClose: () => void;
}

export function MaskEditor(props: Props) {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => dialog.current!.showModal(), []);
  const { value: opened, problem } = useLoaded(() => open(props), once, []);
  return (
    <dialog ref={dialog} class="wide" aria-label={`Mask ${props.name}`} onClose={props.onClose}>
      <div class="dialog-body">
        <h2>
          Mask <bdi>{props.name}</bdi>
        </h2>
        {problem && <ProblemBox problem={problem} />}
        {opened ? <Painting {...props} {...opened} close={() => dialog.current!.close()} /> : !problem && <p class="soft">Loading …</p>}
      </div>
    </dialog>
  );
}

async function open({ path, masked, painted }: Props): Promise<{ photo: ImageData; start: Mask }> {
  const photo = await pixelsOf(`${path}/picture.jpg`);
  const start = painted?.copy() ?? (masked ? Mask.of(await pixelsOf(`${path}/mask.png`)) : new Mask(photo.width, photo.height));
  return { photo, start };
}

async function pixelsOf(path: string): Promise<ImageData> {
  const bitmap = await createImageBitmap(await (await request("GET", path)).blob());
  const canvas = Object.assign(document.createElement("canvas"), { width: bitmap.width, height: bitmap.height });
  const context = canvas.getContext("2d")!;
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height);
}

function Painting({ photo, start, others, onDone, close }: Props & { photo: ImageData; start: Mask; close: () => void }) {
  const [mask, setMask] = useState(start);
  const [before, setBefore] = useState<readonly Mask[]>([]);
  const [share, setShare] = useState(start.share);
  const [tool, setTool] = useState<Tool>("paint");
  const [size, setSize] = useState(0.4);
  const [tolerance, setTolerance] = useState(0.12);
  const [everywhere, setEverywhere] = useState(false);
  const radius = Math.max(0.5, Math.max(photo.width, photo.height) * (0.002 + 0.1 * size * size));
  const remember = () => setBefore((known) => [...known.slice(1 - UNDONE_MAX), mask.copy()]);
  const use = (from: Place, to: Place) => (tool === "fill" ? mask.fill(photo, to, 255 * tolerance) : mask.stroke(from, to, radius, tool === "paint"));
  const undo = () => {
    const last = before.at(-1);
    if (!last) return;
    setBefore(before.slice(0, -1));
    setMask(last);
    setShare(last.share);
  };
  const clear = () => {
    remember();
    mask.clear();
    setShare(0);
  };
  const hidden = 1 - share < COUNTING_MIN;
  return (
    <>
      <div class="mask-tools">
        <Choice label="Tool" value={tool} options={TOOLS} onChange={setTool} />
        {tool === "fill" ? (
          <Range name="Tolerance">
            <Slider value={tolerance} label="Tolerance" text={`${Math.round(100 * tolerance)} %`} onChange={setTolerance} />
          </Range>
        ) : (
          <Range name="Brush">
            <Slider value={size} label="Brush" text={`${Math.round(2 * radius)} px wide`} onChange={setSize} />
          </Range>
        )}
        <button type="button" class="act small" disabled={!before.length} onClick={undo}>
          Undo
        </button>
        <button type="button" class="act small" disabled={share === 0} onClick={clear}>
          Clear
        </button>
        <span class="soft" role="status">
          {hidden ? "Nothing is left of it: leave the photo out instead." : `${Math.ceil(100 * share)} % masked`}
        </span>
      </div>
      <Stage {...{ photo, mask, tool, radius, use }} onBegin={remember} onEnd={() => setShare(mask.share)} />
      {others > 0 && <Switch label={`For the ${count(others, "other photo")} of this size, too`} on={everywhere} onChange={setEverywhere} />}
      <p class="dialog-acts">
        <button
          type="button"
          class="act primary"
          disabled={hidden}
          onClick={() => {
            onDone(mask, everywhere);
            close();
          }}
        >
          Use this mask
        </button>
        <button type="button" class="act" onClick={close}>
          Cancel
        </button>
      </p>
    </>
  );
}

function Range({ name, children }: { name: string; children: ComponentChildren }) {
  return (
    <label class="mask-range">
      <span>{name}</span>
      {children}
    </label>
  );
}
