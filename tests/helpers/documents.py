"""Code blocks of the Markdown documents, and the edits that diffs in them describe."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCUMENTS = {
    path.relative_to(ROOT).as_posix(): path for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
}


class Block(NamedTuple):
    """A fenced block of code."""

    section: str
    """Heading that it stands under."""
    language: str
    code: str
    line: int
    """Of its first line of code, from 1."""


def blocks(path: Path) -> list[Block]:
    """All blocks of a document, in order."""
    found, section, start, language = [], "", None, ""
    lines = path.read_text().split("\n")
    for number, line in enumerate(lines, 1):
        fence = re.match(r"```(\w*)", line)
        if fence and start is None:
            start, language = number + 1, fence[1]
        elif fence:
            assert start is not None
            found.append(Block(section, language, "\n".join(lines[start - 1 : number - 1]) + "\n", start))
            start = None
        elif start is None and line.startswith("#"):
            section = line.lstrip("# ")
    assert start is None, f"{path}: a block without an end"
    return found


def apply_diff(diff: str, folder: Path) -> None:
    """Edit the files that a diff names, below `folder`. A hunk's old lines must stand in its file exactly once; a hunk
    of new lines alone goes to the end."""
    for part in re.split(r"^--- ", diff, flags=re.MULTILINE)[1:]:
        name, *hunks = re.split(r"^@@\n", part, flags=re.MULTILINE)
        path = folder / name.strip()
        content = path.read_text()
        assert hunks, f"{name.strip()}: no hunk"
        for hunk in hunks:
            lines = hunk.splitlines()
            assert all(line[:1] in ("", " ", "+", "-") for line in lines), hunk
            old = "".join(line[1:] + "\n" for line in lines if line[:1] != "+")
            new = "".join(line[1:] + "\n" for line in lines if line[:1] != "-")
            assert content.count(old) == 1 or not old, f"{path.name} has {content.count(old)} times:\n{old}"
            content = content.replace(old, new) if old else content + new
        path.write_text(content)
