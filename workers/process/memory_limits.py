"""Memory limits of programs that read strangers' files: together they fit into the container's.

A container that runs out of memory is killed as a whole, with every request that it serves.
"""

from __future__ import annotations

from dataclasses import dataclass

# A web process itself, after heavy use.
WEB_BYTES = 512 * 2**20
# Without a limit. The check: numpy, Pillow, and decoders with pictures of up to 150 million pixels; a picture for
# pages: one such decoder; unpacking: zlib, and the table of contents of the archive with most entries.
CHECK_BYTES, PICTURE_BYTES, UNPACK_BYTES = 6 * 2**30, 6 * 2**30, 1536 * 2**20
CHECK_VARIABLE = "BIRESNERF_CHECK_MEMORY_BYTES"  # tells the check's program its limit
PICTURES_AT_ONCE, UNPACKED_AT_ONCE = 2, 4
# With less for each, fewer run at once; a picture of 150 million pixels needs the first.
PICTURE_BYTES_MIN, UNPACK_BYTES_MIN = 2816 * 2**20, 128 * 2**20
# With less than this for all of them, the programs do not even start.
SHARED_BYTES_MIN = 2**30


@dataclass(frozen=True)
class MemoryShares:
    """Bytes per program of each kind, and how many of a kind run at a time; there is one check."""

    check: int
    picture: int
    pictures: int
    unpack: int
    unpacks: int


def memory_shares(limit: int | None, processes: int) -> MemoryShares:
    """The memory for the programs of each of ``processes`` web processes, in a container of ``limit`` bytes.

    Half is for the check, three eighths are for pictures. Below 1.5 GiB for each web process the limit cannot be kept.
    """
    if limit is None:
        return MemoryShares(CHECK_BYTES, PICTURE_BYTES, PICTURES_AT_ONCE, UNPACK_BYTES, UNPACKED_AT_ONCE)
    shared = max(limit // processes - WEB_BYTES, SHARED_BYTES_MIN)
    for_pictures, for_archives = 3 * shared // 8, shared // 8
    pictures = max(1, min(PICTURES_AT_ONCE, for_pictures // PICTURE_BYTES_MIN))
    unpacks = max(1, min(UNPACKED_AT_ONCE, for_archives // UNPACK_BYTES_MIN))
    return MemoryShares(
        check=min(CHECK_BYTES, shared // 2),
        picture=min(PICTURE_BYTES, for_pictures // pictures),
        pictures=pictures,
        unpack=min(UNPACK_BYTES, for_archives // unpacks),
        unpacks=unpacks,
    )
