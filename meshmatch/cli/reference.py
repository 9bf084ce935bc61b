"""Write ``docs/cli.md`` from the verbs' own ``--help``: ``python -m meshmatch.cli.reference [--check] [FILE]``."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

HEAD = """# The command line

Made by `python -m meshmatch.cli.reference` from the program's own `--help`; a test keeps it fresh.
"""


def pages() -> Iterator[tuple[str, ...]]:
    """Every command, as the words after the program's name."""
    from typer.main import get_command

    from meshmatch.cli.app import app

    yield ()
    for verb, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        yield (verb,)
        for inner in getattr(command, "commands", {}):
            yield verb, inner


def reference() -> str:
    """The page as markdown. The same on every machine: the width of the terminal plays no part."""
    parts = [HEAD]
    for words in pages():
        parts.append(f"## meshmatch {' '.join(words)}".rstrip() + f"\n\n```text\n{_help(words)}\n```\n")
    return "\n".join(parts)


def _help(words: Sequence[str]) -> str:
    from typer.main import get_command

    from meshmatch.cli.app import app

    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit):
        get_command(app)(args=[*words, "--help"], prog_name="meshmatch", terminal_width=100, color=False)
    return "\n".join(line.rstrip() for line in heard.getvalue().strip().splitlines())


def main(arguments: Sequence[str]) -> int:
    """Write the page, or with --check say whether the file is what would be written."""
    check = "--check" in arguments
    names = [word for word in arguments if word != "--check"]
    file = Path(names[0]) if names else Path(__file__).resolve().parents[2] / "docs" / "cli.md"
    page = reference()
    if not check:
        file.write_text(page, encoding="utf-8")
        return 0
    if file.is_file() and file.read_text(encoding="utf-8") == page:
        return 0
    print(f"{os.path.relpath(file)} is stale: run python -m meshmatch.cli.reference", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
