// The photo and the mask over it, to paint on by pointer and by keyboard.
import { useEffect, useLayoutEffect, useRef, useState } from "preact/hooks";
import type { Mask, Place } from "./mask";

export type Tool = "paint" | "erase" | "fill";

interface Props {
  photo: ImageData;
  mask: Mask;
  tool: Tool;
  /** Of the brush, in pixels of the photo. */
  radius: number;
  /** Called before the mask changes. */
  onBegin: () => void;
  /** Changes the mask on a brush's way, or where both places are the same. */
  use: (from: Place, to: Place) => void;
  /** Called when a change is complete. */
  onEnd: () => void;
}

const ARROWS: Record<string, Place> = {
  ArrowLeft: { x: -1, y: 0 },
  ArrowRight: { x: 1, y: 0 },
  ArrowUp: { x: 0, y: -1 },
  ArrowDown: { x: 0, y: 1 },
};

export function Stage({ photo, mask, tool, radius, onBegin, use, onEnd }: Props) {
  const below = useRef<HTMLCanvasElement>(null);
  const above = useRef<HTMLCanvasElement>(null);
  const last = useRef<Place | null>(null);
  const { width, height } = photo;
  const [brush, setBrush] = useState<Place>({ x: width / 2, y: height / 2 });
  useEffect(() => below.current!.getContext("2d")!.putImageData(photo, 0, 0), [photo]);
  useLayoutEffect(() => mask.draw(above.current!)); // before the browser shows other changes of the same click
  const inside = ({ x, y }: Place): Place => ({ x: Math.max(0, Math.min(width - 0.5, x)), y: Math.max(0, Math.min(height - 0.5, y)) });
  const placeOf = (event: PointerEvent): Place => {
    const box = above.current!.getBoundingClientRect();
    return inside({ x: ((event.clientX - box.left) / box.width) * width, y: ((event.clientY - box.top) / box.height) * height });
  };
  const apply = (from: Place, to: Place) => {
    use(from, to);
    mask.draw(above.current!);
  };
  const once = (from: Place, to: Place) => {
    onBegin();
    apply(from, to);
    onEnd();
  };
  const press = (event: PointerEvent) => {
    if (event.button !== 0) return;
    above.current!.setPointerCapture(event.pointerId);
    const at = placeOf(event);
    setBrush(at);
    if (tool === "fill") return once(at, at);
    last.current = at;
    onBegin();
    apply(at, at);
  };
  const move = (event: PointerEvent) => {
    const at = placeOf(event);
    setBrush(at);
    if (!last.current) return;
    apply(last.current, at);
    last.current = at;
  };
  const release = () => {
    if (last.current) onEnd();
    last.current = null;
  };
  const key = (event: KeyboardEvent) => {
    const by = ARROWS[event.key];
    if (by) {
      const step = Math.max(1, radius);
      const next = inside({ x: brush.x + step * by.x, y: brush.y + step * by.y });
      if (event.shiftKey && tool !== "fill") once(brush, next);
      setBrush(next);
    } else if (event.key === " " || event.key === "Enter") once(brush, brush);
    else return;
    event.preventDefault();
  };
  return (
    <div class="mask-stage" style={{ aspectRatio: `${width} / ${height}`, maxWidth: `calc(56vh * ${width / height})` }}>
      <canvas ref={below} width={width} height={height} aria-hidden="true" />
      <canvas
        ref={above}
        width={width}
        height={height}
        role="application"
        tabIndex={0}
        aria-label="Photo with its mask. Arrow keys move the brush, Space uses it, Shift with an arrow key draws."
        onPointerDown={press}
        onPointerMove={move}
        onPointerUp={release}
        onPointerCancel={release}
        onKeyDown={key}
      />
      <i
        class="mask-brush"
        aria-hidden="true"
        style={{
          left: `${(100 * brush.x) / width}%`,
          top: `${(100 * brush.y) / height}%`,
          width: `${(200 * (tool === "fill" ? 3 : radius)) / width}%`,
        }}
      />
    </div>
  );
}
