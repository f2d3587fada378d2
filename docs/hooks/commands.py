"""Make the command reference from the public functions, one page per command."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

from cyclopts import App
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from cpunet.cli import application

app = application()
FOLDER = "reference/commands"


def commands(below: App = app, name: str = "cpunet") -> Iterator[tuple[str, App]]:
    """The full name and the definition of every command."""
    words = [word for word in below if not word.startswith("-")]
    if not words:
        yield name, below
    for word in words:
        yield from commands(below[word], f"{name} {word}")


def page_of(name: str) -> str:
    return f"{FOLDER}/{name.removeprefix('cpunet ').replace(' ', '-')}.md"


def cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def sections(command: App) -> tuple[str, list[str]]:
    """What the docstring of a function says before its first section, and its examples."""
    text = inspect.getdoc(command.default_command) or ""
    parts = re.split(r"^(\w+)\n-+\n", text, flags=re.MULTILINE)
    of_section = dict(zip(parts[1::2], parts[2::2], strict=True))
    return parts[0].strip(), [line for line in of_section["Examples"].splitlines() if line]


def command_page(name: str, command: App) -> str:
    summary, examples = sections(command)
    lines = [f"# {name}", "", summary, "", "```sh", *examples, "```", ""]
    lines += ["| | | default |", "|---|---|---|"]
    arguments = command.assemble_argument_collection(
        default_parameter=app.default_parameter, parse_docstring=True
    )
    for one in arguments:
        if one.show:
            positional = one.field_info.kind in (
                inspect.Parameter.POSITIONAL_OR_KEYWORD,
                inspect.Parameter.VAR_POSITIONAL,
            )
            word = one.names[0].removeprefix("--").upper() if positional else one.names[0]
            default = one.field_info.default
            shown = "" if default in (None, (), "", False) else f"`{default}`"
            about = cell(one.parameter.help or "")
            lines.append(f"| `{word}` | {about} | {'required' if one.required else shown} |")
    return "\n".join(lines) + "\n"


def index_page() -> str:
    lines = [
        "# Commands",
        "",
        "`cpunet COMMAND --help` prints the same on the screen. `cpunet --debug COMMAND …` "
        "shows the whole traceback if a command fails; `cpunet --version` prints the version.",
        "",
        "| command | |",
        "|---|---|",
    ]
    for name, command in commands():
        link = page_of(name).removeprefix(f"{FOLDER}/")
        lines.append(f"| [`{name}`]({link}) | {cell(command.help)} |")
    return "\n".join(lines) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    pages = {f"{FOLDER}/index.md": index_page()}
    pages |= {page_of(name): command_page(name, command) for name, command in commands()}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_config(config: MkDocsConfig) -> None:
    """Add the pages to the navigation, in the order of ``cpunet --help``."""
    pages = [{"All commands": f"{FOLDER}/index.md"}]
    names = [name for name, _ in commands()]
    pages += [{name.removeprefix("cpunet "): page_of(name)} for name in names]
    reference = next(part["Reference"] for part in config.nav or [] if "Reference" in part)
    reference.append({"Commands": pages})
