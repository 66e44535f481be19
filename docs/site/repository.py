"""A hook of MkDocs: files of the repository beyond docs/ that the pages link to become part of the site.

README.md is the home page. Whatever else a page links to (figures and tables of results, CONTRIBUTING.md, LICENSE) is
taken along under its path in the repository, so that the same links work on the repository's own web pages.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
HOME = "README.md"
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)\s#]+)(#[^)\s]*)?(?=\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the home page, and what is linked to, directly or from what is added."""
    waiting = [*(Path(file.abs_src_path) for file in files.documentation_pages()), ROOT / HOME, ROOT / "CHANGELOG.md"]
    known = set(waiting)
    _add(files, config, "CHANGELOG.md")
    _add(files, config, HOME)
    while waiting:
        page = waiting.pop()
        for target, _ in LINK.findall(page.read_text()):
            path = (page.parent / target).resolve()
            if path in known or not path.is_file() or not path.is_relative_to(ROOT):
                continue  # what does not exist, the strict build names
            known.add(path)
            if not path.is_relative_to(ROOT / "docs"):
                _add(files, config, path.relative_to(ROOT).as_posix())
                waiting += [path] if path.suffix == ".md" else []
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as they are on the site."""
    here = Path(str(page.file.abs_src_path)).parent
    start = posixpath.dirname(page.file.src_uri)

    def there(match: re.Match[str]) -> str:
        path = (here / match[1]).resolve()
        if not path.is_relative_to(ROOT):
            raise PluginError(f"{page.file.src_uri}: {match[1]} is not in the repository")
        return posixpath.relpath(_uri(path.relative_to(ROOT).as_posix()), start or ".") + (match[2] or "")

    return LINK.sub(there, markdown)


def _uri(path: str) -> str:
    """Where a file of the repository is on the site, among its sources."""
    return "index.md" if path == HOME else path.removeprefix("docs/")


def _add(files: Files, config: MkDocsConfig, path: str) -> None:
    files.append(File.generated(config, _uri(path), abs_src_path=str(ROOT / path)))
