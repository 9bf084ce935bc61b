"""The pages lead somewhere, and the reference is whole. What they tell people to type is judged in
``tests/test_readme.py``.
"""

import re
import shlex
from pathlib import Path

import meshmatch

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchors(text: str) -> set[str]:
    """What links to headings of a page are called."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def dead_links(text: str, page: Path) -> list[str]:
    """Local targets of links and pictures that do not exist."""
    dead = []
    for target in re.findall(r"\]\(([^)\s]+)[^)]*\)", text):
        name, _, anchor = target.partition("#")
        if not name.startswith(("http:", "https:", "mailto:")):
            file = page.parent / name if name else page
            if not file.exists() or (anchor and anchor not in anchors(file.read_text(encoding="utf-8"))):
                dead.append(target)
    return dead


def test_links_and_pictures_lead_somewhere() -> None:
    pages = [*PAGES, ROOT / ".github" / "CONTRIBUTING.md"]
    assert [f"{page.name}: {dead}" for page in pages for dead in dead_links(page.read_text("utf-8"), page)] == []


def test_a_dead_link_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "here.md").write_text("# A (`part`) of it\n```text\n# no heading\n```\n")
    text = "[a](here.md#a-part-of-it) ![b](gone.png) [c](https://example.org) [d](here.md#no-heading) [e](#f)"
    (tmp_path / "page.md").touch()
    assert dead_links(text, tmp_path / "page.md") == ["gone.png", "here.md#no-heading", "#f"]


def test_the_pages_match_the_shapes_that_ship() -> None:
    samples = []
    for page in ("README.md", "docs/models.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        calls = [line for line in text.splitlines() if line.startswith("meshmatch match templates/")]
        samples += [ROOT / word for call in calls for word in shlex.split(call)[2:4]]
    assert sorted(samples) == sorted((ROOT / "templates" / "samples").glob("*.ply"))


def test_the_reference_lists_every_public_name_once() -> None:
    listed = [
        name
        for page in sorted((ROOT / "docs" / "reference").glob("*.md"))
        for name in re.findall(r"^::: meshmatch\.(\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert sorted(listed) == sorted(set(meshmatch.__all__) - {"__version__"})


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    named = set(re.findall(r"^ +- ([\w/-]+\.md)$", (ROOT / "docs" / "mkdocs.yml").read_text("utf-8"), re.MULTILINE))
    there = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert named == there | {"index.md", "contributing.md"}


def test_the_paper_page_names_what_is_in_its_files() -> None:
    """That files and commands exist is judged with those of the page of results."""
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+(?:/\w+)+\.py)` `(\w+)", text)
    assert len(named) > 10
    assert [each for each in named if each[1] not in (ROOT / "meshmatch" / each[0]).read_text(encoding="utf-8")] == []


def test_each_version_of_the_changelog_is_as_short_as_a_release_needs() -> None:
    law = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    [limit] = re.findall(r"section of the changelog: at most (\d+) words", law)
    sections = re.split(r"^## ", (ROOT / "docs" / "changelog.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    assert meshmatch.__version__ in [section.split()[0] for section in sections]
    too_long = {section.split()[0]: len(section.split()) for section in sections if len(section.split()) > int(limit)}
    assert too_long == {}
