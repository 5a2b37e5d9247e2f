import { useState } from "preact/hooks";

/** Copies a text, and says so for a moment. */
export function CopyButton({ text, what, label = "Copy" }: { text: string; what: string; label?: string }) {
  const [said, setSaid] = useState("");
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
      setSaid("Copied");
    } catch {
      setSaid("Not allowed here: select and copy it"); // pages over plain HTTP from another machine
    }
    setTimeout(() => setSaid(""), 2500);
  };
  return (
    <>
      <button type="button" class="act small" onClick={copy} aria-label={`${label} ${what}`}>
        {label}
      </button>
      <span class="copied soft" role="status">
        {said}
      </span>
    </>
  );
}
