// The service's page at `/`; the part of the URL after `#` selects the view.
import { render } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { apiKey, keyRequired, setKey } from "./api/http";
import { useStore } from "./api/store";
import { ComparePage } from "./compare/page";
import { ExamplePage } from "./job/example_page";
import { JobPage } from "./job/page";
import { JobsPage } from "./jobs/list";
import { SharedPage } from "./job/shared_page";
import { OperatorLink, OperatorPage } from "./operator/page";
import { ErrorBoundary } from "./parts/error_boundary";
import { KeyForm } from "./parts/key_form";
import { DatasetPage } from "./upload/dataset_page";

interface Route {
  name: "jobs" | "job" | "dataset" | "compare" | "shared" | "example" | "operator";
  id: string;
  /** The second job of a comparison; the token of a link. */
  other?: string;
}

function routeOf(hash: string): Route {
  const [, kind, id, other] = hash.replace(/^#/, "").split("/");
  if (kind === "jobs" && id) return { name: "job", id };
  if (kind === "datasets" && id) return { name: "dataset", id };
  if (kind === "compare" && id && other) return { name: "compare", id, other };
  if (kind === "shared" && id && other) return { name: "shared", id, other };
  return { name: kind === "example" || kind === "operator" ? kind : "jobs", id: "" };
}

/** Pages that need no key. */
const OPEN: ReadonlySet<Route["name"]> = new Set(["shared", "example"]);

function App() {
  const [route, setRoute] = useState(() => routeOf(location.hash));
  const keyError = useStore(keyRequired);
  const key = useStore(apiKey);
  const main = useRef<HTMLElement>(null);
  useEffect(() => {
    const changed = () => {
      setRoute(routeOf(location.hash));
      scrollTo(0, 0);
      main.current?.focus({ preventScroll: true });
    };
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return (
    <>
      <a class="skip" href="#main" onClick={(event) => skip(event, main.current)}>
        Skip to content
      </a>
      <header class="top">
        <a class="brand" href="#/" aria-current={route.name === "jobs" ? "page" : undefined}>
          BiResNeRF
        </a>
        <nav aria-label="Main">
          {route.name !== "shared" && (
            <a href="#/" aria-current={route.name === "jobs" ? "page" : undefined}>
              Jobs
            </a>
          )}
          {!OPEN.has(route.name) && keyError === null && <OperatorLink key={key} here={route.name === "operator"} />}
          <a href="docs">API</a>
          {key && route.name !== "shared" && (
            <button class="plain-link" onClick={() => setKey(null)}>
              Forget the key
            </button>
          )}
        </nav>
      </header>
      <main id="main" ref={main} tabIndex={-1}>
        {keyError !== null ? (
          <KeyForm error={keyError} />
        ) : (
          <ErrorBoundary key={`${route.name} ${route.id} ${route.other} ${route.name === "shared" || key}`}>
            <View {...route} />
          </ErrorBoundary>
        )}
      </main>
    </>
  );
}

function View({ name, id, other = "" }: Route) {
  if (name === "shared") return <SharedPage id={id} token={other} />;
  if (name === "compare") return <ComparePage ids={[id, other]} />;
  if (name === "job") return <JobPage id={id} />;
  if (name === "example") return <ExamplePage />;
  if (name === "operator") return <OperatorPage />;
  if (name === "dataset") return <DatasetPage id={id} />;
  return <JobsPage />;
}

function skip(event: Event, main: HTMLElement | null): void {
  event.preventDefault();
  main?.focus();
}

const root = document.getElementById("app");
if (root) render(<App />, root);
