import { useState } from "preact/hooks";

/** Copies a text and confirms it for a moment. */
export function CopyButton({ text, what, label = "Copy" }: { text: string; what: string; label?: string }) {
  const [status, setStatus] = useState("");
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
      setStatus("Copied");
    } catch {
      setStatus("Copying is blocked: select the text instead"); // browsers allow it on HTTPS and localhost only
    }
    setTimeout(() => setStatus(""), 2500);
  };
  return (
    <>
      <button type="button" class="act small" onClick={copy} aria-label={`${label} ${what}`}>
        {label}
      </button>
      <span class="copied soft" role="status">
        {status}
      </span>
    </>
  );
}
