"""Write ``docs/cli.md`` and ``docs/api.md`` from the program's own help and docstrings.

``python -m meshmatch.experiments.reference [--check] [FOLDER]``
"""

import argparse
import contextlib
import inspect
import io
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from typer.main import get_command

import meshmatch
from meshmatch.cli.app import app

DOCS = Path(__file__).resolve().parents[2] / "docs"
CLI_HEAD = """# The command line

Made by `python -m meshmatch.experiments.reference` from the program's own `--help`; a test keeps it fresh.
"""
API_HEAD = """# The Python library

Made by `python -m meshmatch.experiments.reference` from signatures and docstrings; a test keeps it fresh. All names are
attributes of `meshmatch`, which loads them when they are first used. Whatever a user can get wrong is a
`MeshmatchError` with a `message` and a `hint`.
"""
API = {
    "Matching": ("match", "register", "Matcher", "MatchResult", "Fit", "FitConfig", "VertexMap", "evaluate"),
    "Transfers": (
        *("transfer_texture", "transfer_colors", "transfer_values", "transfer_labels", "transfer_weights"),
        *("transfer_landmarks", "find_maps", "ConfidenceRule", "BakeOptions", "Transferred", "TexturedResult"),
    ),
    "Shapes and files": (
        *("Shape", "Frame", "load_shape", "save_shape", "load_map", "save_map", "load_model"),
        *("MeshmatchError", "MeshmatchWarning"),
    ),
    "Sequences, pictures and pages": ("interpolate", "InterpolationOptions", "Interpolation", "picture", "view"),
    "Collections": ("Collection", "Atlas", "measure_atlas"),
    "Own categories": ("prepare", "train"),
    "Implicit surfaces": (
        *("train_implicit", "load_implicit", "fit_implicit", "implicit_sequence", "ImplicitModel", "ImplicitFit"),
    ),
}


def pages() -> Iterator[tuple[str, ...]]:
    """Every command, as the words after the program's name."""
    yield ()
    for verb, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        yield (verb,)
        for inner in getattr(command, "commands", {}):
            yield verb, inner


def reference() -> str:
    """The commands as markdown. The same on every machine: the width of the terminal plays no part."""
    parts = [CLI_HEAD]
    for words in pages():
        heard = io.StringIO()
        with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit):
            get_command(app)(args=[*words, "--help"], prog_name="meshmatch", terminal_width=100, color=False)
        text = "\n".join(line.rstrip() for line in heard.getvalue().strip().splitlines())
        parts.append(f"## {' '.join(('meshmatch', *words))}\n\n```text\n{text}\n```\n")
    return "\n".join(parts)


def api_reference() -> str:
    """The library as markdown: every public name with its signature and docstring."""
    parts = [API_HEAD]
    for title, names in API.items():
        parts += [f"## {title}\n", *(_entry(name, getattr(meshmatch, name), "###") for name in names)]
    return "\n".join(parts)


def _entry(name: str, thing: object, level: str) -> str:
    text = f"{level} {name}\n\n```python\n{name}{_signature(thing)}\n```\n\n```text\n{inspect.getdoc(thing)}\n```\n"
    if not inspect.isclass(thing):
        return text
    members = {key: value for key, value in vars(thing).items() if not key.startswith("_")}
    lines = [_property(key, value.fget) for key, value in members.items() if isinstance(value, property)]
    if lines:
        text += "\nProperties:\n\n" + "\n".join(lines) + "\n"
    functions = {key: getattr(value, "__func__", value) for key, value in members.items()}
    methods = [(key, value) for key, value in functions.items() if inspect.isfunction(value)]
    return "\n".join([text, *(_entry(f"{name}.{key}", value, "####") for key, value in methods)])


def _property(name: str, read: object) -> str:
    """A line with the name, the type and the first sentence of a property."""
    annotation = getattr(read, "__annotations__", {}).get("return", "")
    return f"- `{name}: {_written(annotation)}` {(inspect.getdoc(read) or '').splitlines()[0]}"


def _signature(thing: object) -> str:
    """As it is written in the source; one parameter a line where it is long."""
    assert callable(thing)
    try:
        signature = inspect.signature(thing)
    except ValueError:
        return ""
    words, starred = [], False
    for parameter in signature.parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            words.append("*")
            starred = True
        annotation = parameter.annotation
        if annotation is inspect.Parameter.empty:
            words.append(str(parameter))
            continue
        default = parameter.default
        shown = f"{type(default).__name__}()" if hasattr(default, "__dataclass_fields__") else repr(default)
        shown = "" if default is inspect.Parameter.empty else f" = {shown}"
        words.append(f"{parameter.name}: {_written(annotation)}{shown}")
    back = signature.return_annotation
    end = "" if back in (inspect.Signature.empty, None, "None") else f" -> {_written(back)}"
    line = f"({', '.join(words)}){end}"
    return line if len(line) < 90 else "(\n    " + ",\n    ".join(words) + f",\n){end}"


def _written(annotation: object) -> str:
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return text.replace("'", '"') if "[" in text else text.strip("'\"")


def main(arguments: Sequence[str]) -> int:
    """Write the pages, or with --check say whether the files are what would be written."""
    parser = argparse.ArgumentParser(
        prog="python -m meshmatch.experiments.reference", description="Write the references."
    )
    parser.add_argument("folder", nargs="?", type=Path, default=DOCS, help="where cli.md and api.md are")
    parser.add_argument("--check", action="store_true", help="write nothing; status 1 if a page is stale")
    words = parser.parse_args(arguments)
    stale = 0
    for name, page in (("cli.md", reference()), ("api.md", api_reference())):
        file = words.folder / name
        if not words.check:
            file.write_text(page, encoding="utf-8")
        elif not file.is_file() or file.read_text(encoding="utf-8") != page:
            print(f"{os.path.relpath(file)} is stale: run python -m meshmatch.experiments.reference", file=sys.stderr)
            stale = 1
    return stale


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
