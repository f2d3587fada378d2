"""Show notebooks as pages, with the results that are stored in them; the file is offered."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

MAGIC = re.compile(r"%%(\w+)\n")


def text_of(value: Any) -> str:
    """Text of a notebook, which is a string or a list of lines."""
    return value if isinstance(value, str) else "".join(value)


def code(source: str) -> str:
    """A cell of code; of those with a magic, in its language."""
    magic = MAGIC.match(source)
    if magic:
        return f"```{magic[1]}\n{source[magic.end() :]}\n```\n"
    return f"```python\n{source}\n```\n"


def results(cell: dict[str, Any]) -> Iterator[str]:
    """What a cell printed, and what it showed: as HTML or a picture if there is one."""
    for output in cell.get("outputs", ()):
        data = output.get("data", {})
        if "text/html" in data:
            # blank lines would end the block that Markdown leaves as it is
            html = re.sub(r"\n\s*\n", "\n", text_of(data["text/html"]).strip())
            yield f'<div class="result">\n{html}\n</div>\n'
        elif "image/png" in data:
            png = "".join(text_of(data["image/png"]).split())
            yield f'<img class="result" alt="" src="data:image/png;base64,{png}">\n'
        elif text := text_of(output.get("text", data.get("text/plain", ""))):
            yield f"```text\n{text.rstrip()}\n```\n"


def page(notebook: Path) -> str:
    """A notebook in Markdown."""
    parts = []
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        source = text_of(cell["source"])
        parts += [source + "\n"] if cell["cell_type"] == "markdown" else [code(source)]
        parts += results(cell)
    parts.append(f"[Download this notebook]({notebook.name}).\n")
    return "\n".join(parts)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for notebook in sorted(Path(config.docs_dir).rglob("*.ipynb")):
        name = notebook.relative_to(config.docs_dir).with_suffix(".md").as_posix()
        files.append(File.generated(config, name, content=page(notebook)))
    return files
