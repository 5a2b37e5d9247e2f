"""What pages show of a checked dataset: its photos with their poses, and pictures of them."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import APIRouter, Path
from fastapi.responses import Response

from biresnerf.wire.datasets import PhotoList
from service.http.access import Caller, ReadCaller
from service.http.dependencies import DatasetId, IfNoneMatch
from service.http.http_conditionals import none_match
from service.http.problems import declared
from service.intake.photo_pictures import PictureName, photo_picture
from workers.records import FIRST_PHOTO, PHOTO_LIST, PHOTO_SHEET

router = APIRouter(prefix="/v1/datasets/{dataset_id}", tags=["datasets"])
_SHOWN: dict[int | str, dict[str, Any]] = {
    304: {"description": "Not modified."},
    **declared("expired", "storage_unavailable"),
}
_Photo = Annotated[int, Path(ge=0, description="Place in the list of photos, from 0.")]
_DRAWN = declared("expired", "storage_unavailable", "validation_timeout", "validation_resources")


def _picture(kind: str, responses: dict[int | str, dict[str, Any]]) -> dict[int | str, dict[str, Any]]:
    content = {f"image/{kind.lower()}": {"schema": {"type": "string"}}}
    return {**_SHOWN, **responses, 200: {"description": f"A {kind}.", "content": content}}


@router.get("/photos", response_model=PhotoList, responses=_SHOWN)
async def list_photos(
    dataset_id: DatasetId, caller: ReadCaller, if_none_match: IfNoneMatch = None
) -> Response:
    """The photos of a checked dataset, with their given poses and lenses."""
    return await _shown(caller, dataset_id, PHOTO_LIST, "application/json", if_none_match)


@router.get("/photos.jpg", response_class=Response, responses=_picture("JPEG", _SHOWN))
async def get_photos_picture(
    dataset_id: DatasetId, caller: ReadCaller, if_none_match: IfNoneMatch = None
) -> Response:
    """All photos of a checked dataset in one picture; `sheet` in the list of photos locates each."""
    return await _shown(caller, dataset_id, PHOTO_SHEET, "image/jpeg", if_none_match)


@router.get("/thumbnail.jpg", response_class=Response, responses=_picture("JPEG", _SHOWN))
async def get_dataset_thumbnail(
    dataset_id: DatasetId, caller: ReadCaller, if_none_match: IfNoneMatch = None
) -> Response:
    """The first photo of a checked dataset, at most 320 px long."""
    return await _shown(caller, dataset_id, FIRST_PHOTO, "image/jpeg", if_none_match)


@router.get("/photos/{photo}/picture.jpg", response_class=Response, responses=_picture("JPEG", _DRAWN))
async def get_photo_picture(
    dataset_id: DatasetId, photo: _Photo, caller: ReadCaller, if_none_match: IfNoneMatch = None
) -> Response:
    """One photo of a checked dataset, oriented as its pose assumes, at most 1,280 px long; not for frames of videos."""
    return await _drawn(caller, dataset_id, photo, "picture.jpg", "image/jpeg", if_none_match)


@router.get("/photos/{photo}/mask.png", response_class=Response, responses=_picture("PNG", _DRAWN))
async def get_photo_mask(
    dataset_id: DatasetId, photo: _Photo, caller: ReadCaller, if_none_match: IfNoneMatch = None
) -> Response:
    """The mask of one photo, the same size as its picture: pixels count where it is white."""
    return await _drawn(caller, dataset_id, photo, "mask.png", "image/png", if_none_match)


async def _shown(
    caller: Caller, dataset_id: str, name: str, kind: str, if_none_match: str | None
) -> Response:
    content = await caller.datasets.shown(dataset_id, name)
    headers = _headers(f'"{hashlib.sha256(content).hexdigest()[:32]}"')
    if not none_match(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(content, media_type=kind, headers=headers)


async def _drawn(
    caller: Caller, dataset_id: str, photo: int, name: PictureName, kind: str, if_none_match: str | None
) -> Response:
    """Draws the picture, or responds 304 without decoding anything if the browser has it."""
    picture = await photo_picture(caller, dataset_id, photo, name)
    headers = _headers(picture.etag)
    if not none_match(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(await picture.drawn(caller), media_type=kind, headers=headers)


def _headers(etag: str) -> dict[str, str]:
    # A checked dataset never changes.
    return {"ETag": etag, "Cache-Control": "private, max-age=86400", "X-Content-Type-Options": "nosniff"}
