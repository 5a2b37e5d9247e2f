"""The web page: the files that `hatch_build.py` builds from service/web, and those of a finished example.

File names contain a digest of the content, so browsers may cache them for a year; index.html, which refers to them, is
revalidated on each visit.
"""

from __future__ import annotations

import re
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, Response

from service.http.problems import ProblemError

FOLDER = Path(__file__).parent / "web" / "dist"
# Files of a result, kept by `make screenshots`.
EXAMPLE = Path(__file__).parent / "example"
CSP = (
    "default-src 'self'; img-src 'self' blob: data:; media-src 'self' blob:; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_NAME = re.compile(r"[a-z-]+-[A-Z0-9]{8}\.(js|css|svg)|licences\.txt")
_MEDIA_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
    ".json": "application/json",
    ".jsonl": "application/jsonl",
    ".jpg": "image/jpeg",
    ".png": "image/png",
    ".bin": "application/octet-stream",
    ".mp4": "video/mp4",
    ".zip": "application/zip",
}
# Best first; the build writes a compressed copy of a file where that is smaller.
_ENCODINGS = {"br": ".br", "gzip": ".gz"}
_SAFE = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}

_IN_EXAMPLE = {path.relative_to(EXAMPLE).as_posix() for path in EXAMPLE.rglob("*") if path.is_file()}

router = APIRouter(include_in_schema=False)


@router.get("/")
@router.head("/")
async def index(request: Request) -> Response:
    """The page; the part of its address after `#`, which only the browser sees, selects the view."""
    if not (FOLDER / "index.html").is_file():
        raise ProblemError(
            "unavailable",
            "The page was not built; only the API under /v1 and its documentation at /docs are available.",
            hint="Run `make web` in the source tree, or install a wheel.",
        )
    headers = {"Content-Security-Policy": CSP, "Cache-Control": "no-cache", "X-Frame-Options": "DENY"}
    return _file("index.html", request, headers)


@router.get("/web/{name}")
@router.head("/web/{name}")
async def part(name: str, request: Request) -> Response:
    """A script, a style sheet or the icon."""
    if not _NAME.fullmatch(name) or not (FOLDER / name).is_file():
        raise ProblemError("not_found", "The page has no such part; load it again.")
    caching = "no-cache" if name == "licences.txt" else "public, max-age=31536000, immutable"
    return _file(name, request, {"Cache-Control": caching})


@router.get("/example/{name:path}")
@router.head("/example/{name:path}")
async def example(name: str) -> Response:
    """A file of the finished example; anybody may see it, as it comes with every installation."""
    if name not in _IN_EXAMPLE:
        raise ProblemError("not_found", "The example has no such file.")
    headers = {**_SAFE, "Cache-Control": "public, max-age=3600"}
    return FileResponse(EXAMPLE / name, media_type=_MEDIA_TYPES[Path(name).suffix], headers=headers)


def _file(name: str, request: Request, headers: dict[str, str]) -> Response:
    path, headers = FOLDER / name, {**_SAFE, **headers, "Vary": "Accept-Encoding"}
    accepted = {item.split(";")[0].strip() for item in request.headers.get("accept-encoding", "").split(",")}
    for encoding, suffix in _ENCODINGS.items():
        packed = FOLDER / (name + suffix)
        if encoding in accepted and packed.is_file():
            path, headers["Content-Encoding"] = packed, encoding
            break
    return FileResponse(path, media_type=_MEDIA_TYPES[Path(name).suffix], headers=headers)
