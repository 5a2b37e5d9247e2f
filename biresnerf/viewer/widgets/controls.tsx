// Small controls and labels that several widgets use.
import type { ComponentChildren } from "preact";
import { useId } from "preact/hooks";
import type { Verdict } from "schemas";
import { VERDICTS } from "./words";

interface OptionsProps<T extends string | number> {
  label: string;
  value: T;
  options: readonly { value: T; text: string }[];
  onChange: (value: T) => void;
}

/** Radio buttons that look like one bar. */
export function Choice<T extends string | number>(props: OptionsProps<T>) {
  const name = useId();
  return (
    <fieldset class="choice">
      <legend>{props.label}</legend>
      <div class="choice-bar">
        {props.options.map((option) => (
          <label key={option.value}>
            <input
              type="radio"
              name={name}
              checked={option.value === props.value}
              onChange={() => props.onChange(option.value)}
            />
            <span>{option.text}</span>
          </label>
        ))}
      </div>
    </fieldset>
  );
}

export function Pick<T extends string | number>(props: OptionsProps<T>) {
  return (
    <label class="pick">
      <span>{props.label}</span>
      <select
        value={String(props.value)}
        onChange={(event) => {
          const chosen = props.options.find((o) => String(o.value) === event.currentTarget.value);
          if (chosen) props.onChange(chosen.value);
        }}
      >
        {props.options.map((option) => (
          <option key={option.value} value={String(option.value)}>
            {option.text}
          </option>
        ))}
      </select>
    </label>
  );
}

export function Switch(props: { label: string; on: boolean; onChange: (on: boolean) => void }) {
  return (
    <label class="switch">
      <input type="checkbox" checked={props.on} onChange={(event) => props.onChange(event.currentTarget.checked)} />
      <span>{props.label}</span>
    </label>
  );
}

/** A slider from 0 to 1. */
export function Slider(props: { value: number; label: string; text: string; onChange: (value: number) => void }) {
  return (
    <input
      type="range"
      min={0}
      max={1}
      step={0.01}
      value={props.value}
      aria-label={props.label}
      aria-valuetext={props.text}
      onInput={(event) => props.onChange(Number(event.currentTarget.value))}
    />
  );
}

export function Button(props: {
  onClick: () => void;
  children: ComponentChildren;
  label?: string;
  disabled?: boolean;
  pressed?: boolean;
}) {
  return (
    <button
      type="button"
      class="button"
      aria-label={props.label}
      aria-pressed={props.pressed}
      disabled={props.disabled}
      onClick={props.onClick}
    >
      {props.children}
    </button>
  );
}

/** The name of the selected image, with buttons for the previous and next one. */
export function ImageStepper(props: {
  names: readonly string[];
  selected: number | null;
  onSelect: (image: number | null) => void;
}) {
  const { names, selected, onSelect } = props;
  const step = (by: number) => onSelect(selected === null ? 0 : (selected + by + names.length) % names.length);
  return (
    <div class="stepper">
      <Button label="Previous image" onClick={() => step(-1)}>
        ‹
      </Button>
      <span class="stepper-name" aria-live="polite">
        {selected === null ? (
          <span class="soft">no image selected</span>
        ) : (
          <>
            <bdi title={names[selected]}>{names[selected]}</bdi>{" "}
            <span class="soft">
              {selected + 1}/{names.length}
            </span>
          </>
        )}
      </span>
      <Button label="Next image" onClick={() => step(1)}>
        ›
      </Button>
    </div>
  );
}

/** A table in a box of its own, which scrolls by keyboard, too; a note may stand below its rows. */
export function ScrolledTable({ label, note, children }: { label: string; note?: ComponentChildren; children: ComponentChildren }) {
  return (
    <div class="table-scroll" tabIndex={0} role="region" aria-label={label}>
      <table class="table">{children}</table>
      {note}
    </div>
  );
}

/** The verdict as a small label. */
export function VerdictChip({ verdict }: { verdict: Verdict["verdict"] }) {
  const { word, tone } = VERDICTS[verdict];
  return <span class={`chip chip-${tone}`}>{word}</span>;
}
