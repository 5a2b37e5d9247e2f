"""MkDocs hook: the repository's pages at their own paths, so that their links lead to the same pages on the site."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
SHOWN = (
    "*.md",
    "CITATION.cff",
    "LICENSE",
    "docs/*.md",
    "docs/*.json",
    "docs/*.txt",
    "docs/pictures/*",
    "docs/studies/*",
    "docs/site/*.css",
    "docs/site/*.js",
    "examples/*.md",
    "examples/*.ipynb",
    "deploy/prometheus/alerts.yaml",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The theme's files, and the repository's in place of those of the docs folder."""
    theme = [file for file in files if file.src_dir != config.docs_dir]
    paths = sorted({path for pattern in SHOWN for path in ROOT.glob(pattern)})
    pages = [
        File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)) for path in paths
    ]
    return Files(theme + pages)
