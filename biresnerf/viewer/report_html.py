"""``report.html``: one file that shows a result in any browser, opened from disk, without network.

Its script is built from the TypeScript in this folder; docs/formats.md lists the data that it embeds.
"""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from PIL import Image

from biresnerf.data.formats.simple.poses_json import POSES
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.show.history import HISTORY
from biresnerf.data.show.view_file import VIEW, ViewFile, read_view_file
from biresnerf.errors import InputError
from biresnerf.report import Report

REPORT_HTML = "report.html"
BUNDLE = Path(__file__).parent / "dist"
# Pictures, points and video before base64, for a page of 12 MB; the rest stays in the result's folder.
MOST_BYTES = 8_000_000
MOST_VIDEO_BYTES = 2_000_000
PICTURE_PX, QUALITY = 640, 82  # long side and JPEG quality of an embedded picture
_POSES = {"complete": "Refined poses", "partial": "Poses so far"}
_MEDIA = {".jpg": "image/jpeg", ".bin": "application/octet-stream"}
NOT_BUILT = (
    "report.html was not written: its viewer is not built. Run `make web`, then `biresnerf report OUT`."
)


def write_report_html(folder: Path, report: Report, title: str | None = None) -> tuple[str, ...]:
    """Writes the page of the result in ``folder`` atomically.

    Args:
        title: the heading; by default the number of images.

    Returns:
        a warning if it could not be written.

    Raises:
        InputError: a file of the result was changed.
    """
    try:
        script, style, licences = (
            (BUNDLE / name).read_text("utf-8") for name in ("report.js", "report.css", "licences.txt")
        )
    except FileNotFoundError:
        return (NOT_BUILT,)
    view = read_view_file(folder) if (folder / VIEW).is_file() else None
    files, left_out = _embedded(folder, view)
    title = title or f"{_POSES[report.state]} of {len(report.images)} images"
    history = folder / HISTORY
    data = {
        "title": title,
        "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "poses": json.loads((folder / (view.poses if view else POSES)).read_text("utf-8")),
        "report": report.model_dump(mode="json"),
        "view": view.model_dump(mode="json") if view else None,
        "history": history.read_text("utf-8") if history.is_file() else "",
        "files": files,
        "left_out": left_out,
    }
    page = _PAGE.format(
        title=html.escape(title),
        style=_inside("style", style),
        data=_as_script(data),
        licences=_as_script(licences),
        script=_inside("script", script),
    )
    write_text(folder / REPORT_HTML, page)
    return ()


def read_report(folder: Path) -> Report:
    """The report.json of the result in ``folder``.

    Raises:
        InputError: ``result_missing`` or ``report_invalid``.
    """
    path = folder / "report.json"
    try:
        return Report.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(
            "result_missing",
            "holds no report.json.",
            where=str(folder),
            hint="Name the output folder of a finished `biresnerf refine`.",
        ) from None
    except ValueError as error:
        raise InputError(
            "report_invalid",
            str(error).splitlines()[0],
            where=str(path),
            hint="Give a result of this version, as it was written.",
        ) from None


def _embedded(folder: Path, view: ViewFile | None) -> tuple[dict[str, str], list[str]]:
    """The result's files as data: URLs, the most important ones first, up to the limit; and what was left out."""
    if view is None:
        return {}, ["Pictures: this result has no view.json."]
    files: dict[str, str] = {}
    spent, over, missing = 0, 0, 0
    for name in _wanted(view):
        path = folder / name
        if not path.is_file():
            missing += 1
            continue
        content, media = _content(path)
        if spent + len(content) > MOST_BYTES:
            over += 1
            continue
        spent += len(content)
        files[name] = _data_url(media, content)
    left_out = []
    if view.orbit is not None and (folder / view.orbit).is_file():
        video = (folder / view.orbit).read_bytes()
        if len(video) <= min(MOST_VIDEO_BYTES, MOST_BYTES - spent):
            files[view.orbit] = _data_url("video/mp4", video)
        else:
            left_out.append(f"The orbit video ({len(video) / 1e6:.1f} MB): {view.orbit}")
    if over:
        left_out.append(
            f"{over} pictures, beyond {MOST_BYTES / 1e6:g} MB; they are in renders/ beside the page."
        )
    if missing:
        left_out.append(f"{missing} files that view.json lists but that are missing.")
    return files, left_out


def _data_url(media: str, content: bytes) -> str:
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"


def _wanted(view: ViewFile) -> Iterator[str]:
    """Names of the files to embed, in order of importance."""
    yield from (points.file for points in view.points)
    if view.contact_sheet is not None:
        yield view.contact_sheet.file
    for kind in ("before", "after", "render", "photo", "difference", "depth"):
        yield from (shown.pictures.files()[kind] for shown in view.views if kind in shown.pictures.files())


def _content(path: Path) -> tuple[bytes, str]:
    """The bytes of a file, pictures scaled down, and their media type."""
    if path.suffix != ".png":
        return path.read_bytes(), _MEDIA[path.suffix]
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((PICTURE_PX, PICTURE_PX), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=QUALITY)
    return buffer.getvalue(), "image/jpeg"


def _as_script(data: object) -> str:
    """JSON that cannot end its script element: HTML ends a script at any ``</script``, even within a string."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _inside(tag: str, code: str) -> str:
    """Our own code, checked for end tags: JavaScript has no uniform way to escape them."""
    if f"</{tag}" in code.lower() or (tag == "script" and "<!--" in code):
        raise ValueError(f"the bundle holds the end of a {tag} element")
    return code


# The policy makes the browser block every request.
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline'; \
style-src 'unsafe-inline'; img-src data: blob:; media-src data:; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<div id="report"></div>
<noscript>This page needs JavaScript. report.json in the same folder holds the numbers.</noscript>
<script type="application/json" id="data">{data}</script>
<script type="application/json" id="licences">{licences}</script>
<script>{script}</script>
</body>
</html>"""
