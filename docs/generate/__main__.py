"""`python -m docs.generate`: writes every page and notebook that is generated from the code."""

from __future__ import annotations

from docs.generate.pages import GENERATED


def main() -> None:
    """Writes the files that differ, and prints their names."""
    for path, write in GENERATED.items():
        text = write()
        if not path.is_file() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")
            print(f"written: {path}")


if __name__ == "__main__":
    main()
