"""Make the pages of the Python reference from the docstrings: one per folder of the package."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "cpunet"
FOLDER = "reference/python"
COMMANDS = "cli.py"  # has a reference of its own
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
# As data flow; a room that is not named there comes last.
ORDER = PROJECT["tool"]["cpunet"]["rooms"]
OPTIONS = (
    "options:",
    "  heading_level: 3",
    "  show_root_heading: false",
    "  show_root_toc_entry: false",
)
# found below the guides where both have a word
SEARCHED_LAST = "---\nsearch: {boost: 0.2}\n---\n"
NAMES = """
train translate validate compare calibrate simulate Simulation make_stand Stand info load
check response demo tune list_recipes import_weights export_onnx export_legend make_library
translate_library LegendParameters Adc Run Translation Report Comparison
Calibration Plan PulseFile HitFile FileOptions HitOptions ReadOptions CpunetError
open_pulses Pulses REN IREN
"""
FRONT = """# Python

What `import cpunet` gives is the stable interface; everything else is sorted by room, in the
order in which data flow.
"""
FRONT += "".join(f"\n::: cpunet.{name}\n" for name in NAMES.split())
FRONT = FRONT.replace(".REN\n", ".REN\n    options:\n      inherited_members: true\n")


def public_modules(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("[!_]*.py") if path.name != COMMANDS)


def name_of(path: Path) -> str:
    return ".".join(("cpunet", *path.relative_to(SOURCE).with_suffix("").parts))


def page_of(folder: Path) -> str:
    parts = folder.relative_to(SOURCE).parts
    return f"{FOLDER}/{'-'.join(parts) or 'foundations'}.md"


def first_line(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return text.partition("\n")[0]


def place(folder: Path) -> tuple[int, tuple[str, ...]]:
    """Where a folder stands in the order of the rooms."""
    parts = folder.relative_to(SOURCE).parts
    if not parts:
        return -1, parts
    return (ORDER.index(parts[0]) if parts[0] in ORDER else len(ORDER)), parts


def rooms() -> Iterator[Path]:
    """Folders of the package that hold modules to show, the package's own first."""
    for folder in sorted((path.parent for path in SOURCE.rglob("__init__.py")), key=place):
        if public_modules(folder):
            yield folder


def room_page(folder: Path) -> str:
    title = ".".join(("cpunet", *folder.relative_to(SOURCE).parts))
    about = "" if folder == SOURCE else first_line(folder / "__init__.py")
    lines = [SEARCHED_LAST, f"# {title}", "", about, ""]
    for path in public_modules(folder):
        name = name_of(path)
        lines += [f"## {path.stem} {{ #{name} }}", "", f"::: {name}", ""]
        lines += [f"    {line}" for line in OPTIONS] + [""]
    return "\n".join(lines)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    files.append(File.generated(config, f"{FOLDER}/index.md", content=FRONT))
    for folder in rooms():
        files.append(File.generated(config, page_of(folder), content=room_page(folder)))
    return files


def on_config(config: MkDocsConfig) -> None:
    """Add the pages to the navigation."""
    names = ((".".join(f.relative_to(SOURCE).parts) or "foundations", f) for f in rooms())
    pages = [{"The interface": f"{FOLDER}/index.md"}]
    pages += [{name: page_of(folder)} for name, folder in names]
    reference = next(part["Reference"] for part in config.nav or [] if "Reference" in part)
    reference.append({"Python": pages})
