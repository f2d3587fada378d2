"""Make the command reference from the command line itself, one page per command."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from enum import Enum
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from cyclopts import App
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from cpunet.cli.app import app as of_functions
from cpunet.cli.main import app

FOLDER = "reference/commands"
MARKUP = re.compile(r"\[/?(?:bold|italic|dim|cyan|green|red|yellow)\]")


def commands(command: Any = None, name: str = "cpunet") -> Iterator[tuple[str, Any]]:
    """The full name and the parsed definition of every command that is not hidden."""
    command = command or typer.main.get_command(app)
    if not hasattr(command, "commands"):
        yield name, command
        return
    for word, below in command.commands.items():
        if not below.hidden:
            yield from commands(below, f"{name} {word}")


def functions(below: App = of_functions, name: str = "cpunet") -> Iterator[tuple[str, App]]:
    """The same of every command that is made of a function."""
    words = [word for word in below if not word.startswith("-")]
    if not words:
        yield name, below
    for word in words:
        yield from functions(below[word], f"{name} {word}")


def page_of(name: str) -> str:
    return f"{FOLDER}/{name.removeprefix('cpunet ').replace(' ', '-')}.md"


def cell(text: str) -> str:
    return MARKUP.sub("", text).replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def summary_and_examples(text: str) -> tuple[str, list[str]]:
    """A command's help without its lines ``Example: …``, and these."""
    parts = [part.strip() for part in MARKUP.sub("", text).split("\n\n") if part.strip()]
    examples = [
        " ".join(p.removeprefix("Example:").split()) for p in parts if p[:8] == "Example:"
    ]
    return "\n\n".join(part for part in parts if part[:8] != "Example:"), examples


def kind_of(annotation: Any) -> str:
    """What a value looks like: ``PATH``, ``INT``, or the words to choose from."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType, list, tuple):
        return kind_of(next(kind for kind in inner if kind is not type(None)))
    if origin is Literal:
        return " or ".join(map(str, inner))
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " or ".join(str(choice.value) for choice in annotation)
    return "TEXT" if annotation is str else annotation.__name__.upper()


def default_of(option: Any) -> str:
    if isinstance(option.show_default, str):  # what the code finds out by itself
        return f"`{option.show_default}`"
    return (
        "" if option.is_flag or option.default in (None, (), [], "") else f"`{option.default}`"
    )


def option_row(option: Any, kind: str) -> str:
    if option.param_type_name == "argument":
        spelled = f"`{option.name.upper()}{'…' if option.nargs != 1 else ''}`"
    else:
        spelled = ", ".join(f"`{word}`" for word in (*option.opts, *option.secondary_opts))
        if not option.is_flag:
            spelled += f" `{kind}`"
    shown = "required" if option.required else default_of(option)
    note = " Repeatable." if option.multiple and "repeatable" not in (option.help or "") else ""
    return f"| {spelled} | {cell(option.help or '')}{note} | {shown} |"


def command_page(name: str, command: Any) -> str:
    summary, examples = summary_and_examples(command.help or "")
    kinds = get_type_hints(command.callback)
    lines = [f"# {name}", "", summary, ""]
    if examples:
        lines += ["```sh", *examples, "```", ""]
    tables: dict[str, list[str]] = {}
    for option in command.params:
        if not getattr(option, "hidden", False):
            usual = f"{option.param_type_name.title()}s"
            title = getattr(option, "rich_help_panel", None) or usual
            row = option_row(option, kind_of(kinds.get(option.name, str)))
            tables.setdefault(title, []).append(row)
    for title, rows in tables.items():
        lines += [f"## {title}", "", "| | | default |", "|---|---|---|", *rows, ""]
    return "\n".join(lines)


def sections(command: App) -> tuple[str, list[str]]:
    """What the docstring of a function says before its first section, and its examples."""
    text = inspect.getdoc(command.default_command) or ""
    parts = re.split(r"^(\w+)\n-+\n", text, flags=re.MULTILINE)
    of_section = dict(zip(parts[1::2], parts[2::2], strict=True))
    return parts[0].strip(), [line for line in of_section["Examples"].splitlines() if line]


def function_page(name: str, command: App) -> str:
    summary, examples = sections(command)
    lines = [f"# {name}", "", summary, "", "```sh", *examples, "```", ""]
    lines += ["| | | default |", "|---|---|---|"]
    arguments = command.assemble_argument_collection(
        default_parameter=of_functions.default_parameter, parse_docstring=True
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
        summary, _ = summary_and_examples(command.help or "")
        link = page_of(name).removeprefix(f"{FOLDER}/")
        first = summary.partition("\n\n")[0]
        lines.append(f"| [`{name}`]({link}) | {cell(first)} |")
    for name, command in functions():
        link = page_of(name).removeprefix(f"{FOLDER}/")
        lines.append(f"| [`{name}`]({link}) | {cell(command.help)} |")
    return "\n".join(lines) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    pages = {f"{FOLDER}/index.md": index_page()}
    pages |= {page_of(name): command_page(name, command) for name, command in commands()}
    pages |= {page_of(name): function_page(name, command) for name, command in functions()}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_config(config: MkDocsConfig) -> None:
    """Add the pages to the navigation, in the order of ``cpunet --help``."""
    pages = [{"All commands": f"{FOLDER}/index.md"}]
    names = [name for name, _ in (*commands(), *functions())]
    pages += [{name.removeprefix("cpunet "): page_of(name)} for name in names]
    reference = next(part["Reference"] for part in config.nav or [] if "Reference" in part)
    reference.append({"Commands": pages})
