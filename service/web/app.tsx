// The page that the service shows at `/`.
import { render } from "preact";

function App() {
  return (
    <main>
      <h1>BiResNeRF</h1>
      <p>
        <a href="docs">The HTTP interface</a>
      </p>
    </main>
  );
}

const root = document.getElementById("app");
if (root) render(<App />, root);
