// A value that several components share.
import { useEffect, useState } from "preact/hooks";

export class Store<T> {
  private readonly watchers = new Set<() => void>();

  constructor(private current: T) {}

  get value(): T {
    return this.current;
  }

  set(value: T): void {
    this.current = value;
    for (const watcher of [...this.watchers]) watcher();
  }

  /** The value with some of its fields changed. */
  change(part: Partial<T>): void {
    this.set({ ...this.current, ...part });
  }

  watch(watcher: () => void): () => void {
    this.watchers.add(watcher);
    return () => void this.watchers.delete(watcher);
  }
}

/** The store's value; the component renders again when it changes. */
export function useStore<T>(store: Store<T>): T {
  const [, rerender] = useState(0);
  useEffect(() => {
    rerender((n) => n + 1); // it may have changed since it was rendered
    return store.watch(() => rerender((n) => n + 1));
  }, [store]);
  return store.value;
}
