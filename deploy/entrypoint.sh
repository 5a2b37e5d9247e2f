#!/bin/sh
# Puts the compiled kernels of the image where Numba may add to them (on another kind of CPU it compiles its own),
# then becomes the command.
set -eu
case "${2:-}" in
  worker | up | demo | refine)
    if ! cmp -s /opt/kernels/made-from "$NUMBA_CACHE_DIR/made-from"; then
      # Whole at once: another container may use or start on the same volume.
      fresh="$NUMBA_CACHE_DIR.$(hostname).$$"
      cp -Rp /opt/kernels "$fresh"
      [ ! -d "$NUMBA_CACHE_DIR" ] || mv "$NUMBA_CACHE_DIR" "$fresh.old"
      mv -T "$fresh" "$NUMBA_CACHE_DIR" || rm -rf "$fresh"
      rm -rf "$fresh.old"
    fi
    ;;
esac
exec "$@"
