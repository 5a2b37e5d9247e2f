// A value that several parts of the page look at.
import { useEffect, useState } from "preact/hooks";

export class Store<T> {
  private readonly watchers = new Set<() => void>();

  constructor(private held: T) {}

  get value(): T {
    return this.held;
  }

  set(value: T): void {
    this.held = value;
    for (const watcher of [...this.watchers]) watcher();
  }

  /** The value with some of its fields changed. */
  change(part: Partial<T>): void {
    this.set({ ...this.held, ...part });
  }

  watch(watcher: () => void): () => void {
    this.watchers.add(watcher);
    return () => void this.watchers.delete(watcher);
  }
}

/** The store's value; the component is drawn again whenever it changes. */
export function useStore<T>(store: Store<T>): T {
  const [, redraw] = useState(0);
  useEffect(() => {
    redraw((n) => n + 1); // it may have changed before anybody watched
    return store.watch(() => redraw((n) => n + 1));
  }, [store]);
  return store.value;
}
