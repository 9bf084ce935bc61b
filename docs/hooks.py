"""What the site adds to mkdocs: the pages where GitHub shows them, their links, and the reference of the commands."""

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from typer.main import get_command

from meshmatch.cli.app import app

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
REPOSITORY = "https://github.com/meshmatch/meshmatch"
FROM_ELSEWHERE = {"README.md": "index.md", ".github/CONTRIBUTING.md": "contributing.md"}
CLI = "reference/cli.md"
LINK = re.compile(r"(\]\(|\b(?:src|href)=\")([^)\s\"]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages and pictures of docs/, the README as the first page, CONTRIBUTING, and the commands."""
    held = [path for pattern in ("*.md", "reference/*.md", "images/*") for path in DOCS.glob(pattern)]
    sources = {path.relative_to(DOCS).as_posix(): path for path in held}
    sources |= {name: ROOT / source for source, name in FROM_ELSEWHERE.items()}
    for name, path in sorted(sources.items()):
        files.append(File.generated(config, name, abs_src_path=str(path)))
    files.remove(files.src_uris[CLI])
    files.append(File.generated(config, CLI, content=(DOCS / CLI).read_text(encoding="utf-8") + commands()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links that leave docs/ to the page they are here, or to the repository."""
    name = page.file.src_uri
    origin = {to: source for source, to in FROM_ELSEWHERE.items()}.get(name, f"docs/{name}")

    def here(found: re.Match[str]) -> str:
        target, _, anchor = found[2].partition("#")
        if not target or re.match(r"\w+:", target):
            home = str(config.site_url)
            return found[0] if not target.startswith(home) else found[1] + _relative(found[2].removeprefix(home), name)
        path = posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))
        to = FROM_ELSEWHERE.get(path, path.removeprefix("docs/"))
        if to not in files.src_uris:
            if not (ROOT / path).exists():
                return found[0]  # mkdocs says that it leads nowhere
            return f"{found[1]}{REPOSITORY}/{'tree' if (ROOT / path).is_dir() else 'blob'}/main/{path}"
        return found[1] + _relative(to, name) + (f"#{anchor}" if anchor else "")

    return LINK.sub(here, markdown)


def _relative(target: str, page: str) -> str:
    """A page of the site, seen from another; its address becomes its source, which mkdocs checks."""
    name, mark, anchor = (target or "index.html").partition("#")
    return posixpath.relpath(name.replace(".html", ".md"), posixpath.dirname(page) or ".") + mark + anchor


def commands() -> str:
    """Every command with its usage, its words and a table of its options, as markdown."""
    root: Any = get_command(app)
    parts: list[str] = []
    for verb, command in root.commands.items():
        parts += _entry(f"meshmatch {verb}", command, 2)
        for inner, nested in getattr(command, "commands", {}).items():
            parts += _entry(f"meshmatch {verb} {inner}", nested, 3)
    return "\n".join(parts)


def _entry(name: str, command: Any, level: int) -> list[str]:
    with command.make_context(name, [], resilient_parsing=True) as context:
        usage = " ".join(command.collect_usage_pieces(context))
        rows = [record for each in command.params if (record := each.get_help_record(context))]
    text = (command.help or "").replace("\b", "").strip()
    parts = [f"\n{'#' * level} {name}\n", f"```text\n{name} {usage}\n```\n", *(f"{_escaped(text)}\n" if text else "",)]
    if not hasattr(command, "commands"):
        parts += ["| option | meaning |", "|---|---|"]
        parts += [f"| `{words}` | {_cell(meaning)} |" for words, meaning in rows]
    return parts


def _escaped(text: str) -> str:
    return text.replace("<", "&lt;")


def _cell(text: str) -> str:
    return _escaped(" ".join(text.split())).replace("|", "\\|").replace("*", "\\*").replace("  ", " ")
