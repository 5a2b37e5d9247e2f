// Asks for an API key where the service requires one.
import { useState } from "preact/hooks";
import { setKey } from "../api/http";
import { useTitle } from "./title";

export function KeyForm({ error }: { error: string }) {
  const [text, setText] = useState("");
  useTitle("API key");
  return (
    <form
      class="card key-form"
      onSubmit={(event) => {
        event.preventDefault();
        if (text.trim()) setKey(text.trim());
      }}
    >
      <h1>This service requires an API key</h1>
      {error && (
        <p class="bad" role="alert">
          {error}
        </p>
      )}
      <p>
        Its operator creates one with <code>biresnerf keys create NAME</code>. The key is kept in this tab only, until the
        tab is closed.
      </p>
      <label for="api-key">API key</label>
      <input
        id="api-key"
        type="password"
        autocomplete="off"
        spellcheck={false}
        placeholder="brn_…"
        value={text}
        onInput={(event) => setText(event.currentTarget.value)}
      />
      <p>
        <button class="act primary">Use this key</button>
      </p>
    </form>
  );
}
