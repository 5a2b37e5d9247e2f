// The table of images: one row each, sorted by a click on a heading, filtered by name and flag.
import { useMemo, useState } from "preact/hooks";
import type { ImageRow, SheetCell } from "../result/widget_data";
import { Pick, ScrolledTable } from "./controls";
import { count, fixed, short, signed } from "./numbers";
import { Thumb } from "./thumb";
import { ALARMING, FLAGS, sourceWords } from "./words";

export interface ImageTableProps {
  readonly rows: readonly ImageRow[];
  readonly selected: number | null;
  readonly onSelect: (image: number | null) => void;
  /** The image's cell in the contact sheet. */
  readonly cellOf?: (image: number) => SheetCell | null;
  /** The ticked images, if images can be ticked. */
  readonly ticked?: ReadonlySet<number>;
  readonly onTick?: (image: number, on: boolean) => void;
}

const SHOWN_AT_FIRST = 200;
const THUMB_PX = 30;

interface Column {
  readonly key: string;
  readonly title: string;
  readonly hint: string;
  readonly value: (row: ImageRow) => number | string | null;
  readonly text: (row: ImageRow) => string;
}

const gain = (row: ImageRow): number | null =>
  row.psnr_before === null || row.psnr_after === null ? null : row.psnr_after - row.psnr_before;

const bound = (value: number | null, row: ImageRow): string =>
  value === null ? (row.why_unknown === null ? "–" : "not known") : `± ${short(value)}`;

const COLUMNS: readonly Column[] = [
  { key: "moved_deg", title: "turned °", hint: "Rotation from the input's pose to the refined one", value: (r) => r.moved_deg, text: (r) => fixed(r.moved_deg, 2) },
  { key: "moved_units", title: "moved", hint: "Distance between the centres, in the input's units", value: (r) => r.moved_units, text: (r) => short(r.moved_units) },
  { key: "rotation_90", title: "exact to °", hint: "Nine in ten rotation errors of returned poses are within this bound", value: (r) => r.rotation_90, text: (r) => bound(r.rotation_90, r) },
  { key: "position_90", title: "exact to units", hint: "Nine in ten errors of returned centres are within this bound, in the input's units", value: (r) => r.position_90, text: (r) => bound(r.position_90, r) },
  { key: "psnr_before", title: "PSNR before", hint: "dB, in the verdict's training on the input's poses", value: (r) => r.psnr_before, text: (r) => fixed(r.psnr_before, 2) },
  { key: "psnr_after", title: "PSNR after", hint: "dB, in the verdict's training on the refined poses", value: (r) => r.psnr_after, text: (r) => fixed(r.psnr_after, 2) },
  { key: "gain", title: "gain dB", hint: "PSNR after minus before", value: gain, text: (r) => signed(gain(r), 2) },
  { key: "epipolar_px_before", title: "match px before", hint: "Median epipolar error of feature matches with the input's poses, px", value: (r) => r.epipolar_px_before, text: (r) => short(r.epipolar_px_before) },
  { key: "epipolar_px_after", title: "match px after", hint: "The same with the refined poses, px", value: (r) => r.epipolar_px_after, text: (r) => short(r.epipolar_px_after) },
  { key: "psnr", title: "PSNR end", hint: "Render against photo at the end, dB; held-out views only", value: (r) => r.psnr, text: (r) => fixed(r.psnr, 2) },
];
const NAME: Column = { key: "name", title: "image", hint: "", value: (r) => r.name, text: (r) => r.name };
const SOURCE: Column = { key: "source", title: "pose from", hint: "Where its initial pose comes from", value: (r) => r.source, text: (r) => sourceWords(r.source) };

const natural = new Intl.Collator("en", { numeric: true });

function sorted(rows: readonly ImageRow[], by: Column, down: boolean): ImageRow[] {
  return [...rows].sort((a, b) => {
    const [x, y] = [by.value(a), by.value(b)];
    if (x === null || y === null) return x === y ? a.image - b.image : x === null ? 1 : -1; // unknown comes last
    const order = typeof x === "number" && typeof y === "number" ? x - y : natural.compare(String(x), String(y));
    return (down ? -order : order) || a.image - b.image;
  });
}

/** A bar of this length fills its cell at least: beside smaller turns none would mean anything. */
const LEAST_BAR_DEG = 0.1;

export function ImageTable({ rows, selected, onSelect, cellOf, ticked, onTick }: ImageTableProps) {
  const [order, setOrder] = useState<{ key: string; down: boolean } | null>(null);
  const [text, setText] = useState("");
  const [kind, setKind] = useState("");
  const [all, setAll] = useState(false);
  const columns = useMemo(() => COLUMNS.filter((column) => 2 * rows.filter((row) => column.value(row) !== null).length >= rows.length), [rows]);
  const kinds = useMemo(() => [...new Set(rows.flatMap((row) => row.flags))].sort(), [rows]);
  const sources = useMemo(() => [...new Set(rows.map((row) => row.source))].sort(), [rows]);
  const most = useMemo(() => Math.max(LEAST_BAR_DEG, ...rows.map((row) => row.moved_deg)), [rows]);
  const found = useMemo(() => {
    const wanted = text.toLocaleLowerCase();
    const kept = rows.filter(
      (row) =>
        row.name.toLocaleLowerCase().includes(wanted) &&
        (kind === "" || row.flags.some((flag) => flag === kind) || kind === `from ${row.source}`),
    );
    const by = [NAME, SOURCE, ...COLUMNS].find((column) => column.key === order?.key);
    return by && order ? sorted(kept, by, order.down) : kept;
  }, [rows, text, kind, order]);
  const shown = all ? found : found.slice(0, SHOWN_AT_FIRST);
  const heading = (column: Column, first: "down" | "up", className: string) => (
    <Heading
      key={column.key}
      column={column}
      className={className}
      order={order?.key === column.key ? (order.down ? "descending" : "ascending") : "none"}
      onClick={() =>
        setOrder(
          order?.key === column.key ? { key: column.key, down: !order.down } : { key: column.key, down: first === "down" },
        )
      }
    />
  );
  return (
    <section class="images" aria-label="Images">
      <div class="images-controls">
        <label class="pick">
          <span>Find</span>
          <input type="search" value={text} placeholder="name" onInput={(event) => setText(event.currentTarget.value)} />
        </label>
        <Pick
          label="Show"
          value={kind}
          onChange={setKind}
          options={[
            { value: "", text: "all" },
            ...kinds.map((flag) => ({ value: flag, text: FLAGS[flag] })),
            ...(sources.length > 1
              ? sources.map((source) => ({ value: `from ${source}`, text: `pose from ${sourceWords(source)}` }))
              : []),
          ]}
        />
        <span class="soft" role="status">
          {found.length === rows.length ? count(rows.length, "image") : `${found.length} of ${count(rows.length, "image")}`}
        </span>
      </div>
      <ScrolledTable label="Table of images" note={found.length === 0 && <p class="notice">No image matches.</p>}>
        <thead>
          <tr>
            {onTick && (
              <th scope="col">
                <span class="unseen">selected</span>
              </th>
            )}
            {heading(NAME, "up", "")}
            {columns.map((column) => heading(column, "down", "number"))}
            {heading(SOURCE, "up", "")}
            <th scope="col">flags</th>
          </tr>
        </thead>
        <tbody>
          {shown.map((row) => (
            <tr
              key={row.image}
              aria-current={row.image === selected ? "true" : undefined}
              data-image={row.image}
              onClick={() => onSelect(row.image)}
            >
              {onTick && (
                <td class="tick" onClick={(event) => event.stopPropagation()}>
                  <input
                    type="checkbox"
                    aria-label={`Select ${row.name}`}
                    checked={ticked?.has(row.image) ?? false}
                    onChange={(event) => onTick(row.image, event.currentTarget.checked)}
                  />
                </td>
              )}
              <th scope="row">
                <span class="images-name">
                  {cellOf && <Thumb cell={cellOf(row.image)} size={THUMB_PX} />}
                  <button type="button" class="link" onClick={() => onSelect(row.image)}>
                    <bdi>{row.name}</bdi>
                  </button>
                </span>
              </th>
              {columns.map((column) => (
                <td key={column.key} class="number" title={column.key.endsWith("_90") ? row.why_unknown ?? undefined : undefined}>
                  {column.key === "moved_deg" && (
                    <span class="bar" style={{ width: `${(100 * row.moved_deg) / most}%` }} aria-hidden="true" />
                  )}
                  {column.text(row)}
                </td>
              ))}
              <td>{sourceWords(row.source)}</td>
              <td>
                {row.flags.map((flag) => (
                  <span key={flag} class={ALARMING.has(flag) ? "flag flag-bad" : "flag"}>
                    {FLAGS[flag]}
                  </span>
                ))}
              </td>
            </tr>
          ))}
        </tbody>
      </ScrolledTable>
      {found.length > shown.length && (
        <button type="button" class="button" onClick={() => setAll(true)}>
          Show all {found.length}
        </button>
      )}
    </section>
  );
}

function Heading(props: {
  column: Column;
  className: string;
  order: "ascending" | "descending" | "none";
  onClick: () => void;
}) {
  return (
    <th scope="col" class={props.className} aria-sort={props.order} title={props.column.hint || undefined}>
      <button type="button" class="sort" onClick={props.onClick}>
        {props.column.title}
        <span aria-hidden="true">{{ ascending: "▲", descending: "▼", none: "" }[props.order]}</span>
      </button>
    </th>
  );
}
