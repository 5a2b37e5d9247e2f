// Asks for an API key where the service wants one.
import { useState } from "preact/hooks";
import { useKey } from "../api/http";
import { useTitle } from "./title";

export function KeyForm({ said }: { said: string }) {
  const [text, setText] = useState("");
  useTitle("API key");
  return (
    <form
      class="card key-form"
      onSubmit={(event) => {
        event.preventDefault();
        if (text.trim()) useKey(text.trim());
      }}
    >
      <h1>This service wants an API key</h1>
      {said && (
        <p class="bad" role="alert">
          {said}
        </p>
      )}
      <p>
        Whoever runs it makes one with <code>biresnerf keys create NAME</code>. It is kept in this tab alone, until the tab
        is closed.
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
        <button class="act primary">Use it</button>
      </p>
    </form>
  );
}
