// Shows a fault of the page itself in words, with the rest of the page still there.
import { Component, type ComponentChildren } from "preact";

export class ErrorBoundary extends Component<{ children: ComponentChildren }, { error: Error | null }> {
  override state = { error: null };

  static override getDerivedStateFromError(error: Error) {
    return { error };
  }

  override render({ children }: { children: ComponentChildren }, { error }: { error: Error | null }) {
    if (!error) return children;
    return (
      <div class="problem" role="alert">
        <h3>This view cannot be shown</h3>
        <p>The page has a fault; the job and its files are not affected.</p>
        <p>
          <strong>What to do:</strong> reload the page. If that does not help, send the operator this line:
        </p>
        <pre tabIndex={0}>{String(error)}</pre>
        <p>
          <a href="#/">All jobs</a>
        </p>
      </div>
    );
  }
}
