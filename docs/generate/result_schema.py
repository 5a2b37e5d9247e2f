"""The JSON Schema of the JSON files of a result."""

from __future__ import annotations

import json

from pydantic.json_schema import GenerateJsonSchema, models_json_schema

from biresnerf.data.formats.simple.poses_json import PosesDocument
from biresnerf.data.seeding.seeding_preview import SeedingPreview
from biresnerf.data.show.history import HistoryLine
from biresnerf.data.show.view_file import ViewFile
from biresnerf.report import Report

FILES = {
    "report.json": Report,
    "poses.json": PosesDocument,
    "view.json": ViewFile,
    "a line of history.jsonl": HistoryLine,
    "preview/seeding.json": SeedingPreview,
}


class _Written(GenerateJsonSchema):
    """Requires every field, even with a default: files hold all of them."""

    def field_is_required(self, field: object, total: bool) -> bool:
        return True


def result_schema() -> str:
    """A definition for each file."""
    models = [(model, "serialization") for model in FILES.values()]
    _, schema = models_json_schema(models, schema_generator=_Written)
    # Except for lines of the history, which omit what was not measured.
    fields = HistoryLine.model_fields.items()
    schema["$defs"]["HistoryLine"]["required"] = [name for name, field in fields if field.is_required()]
    schema["$comment"] = ", ".join(f"{model.__name__}: {file}" for file, model in FILES.items())
    return json.dumps(schema, indent=1) + "\n"
