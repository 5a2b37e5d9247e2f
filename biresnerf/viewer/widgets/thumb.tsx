// An image's picture, cut from the contact sheet.
import type { SheetCell } from "../result/widget_data";

export function Thumb({ cell, size }: { cell: SheetCell | null; size: number }) {
  if (!cell) return null;
  const scale = size / Math.max(cell.width, cell.height);
  return (
    <span
      class="thumb"
      aria-hidden="true"
      style={{
        width: `${cell.width * scale}px`,
        height: `${cell.height * scale}px`,
        backgroundImage: `url("${cell.url}")`,
        backgroundPosition: `${-cell.x * scale}px ${-cell.y * scale}px`,
        backgroundSize: `${cell.sheet_width * scale}px ${cell.sheet_height * scale}px`,
      }}
    />
  );
}
