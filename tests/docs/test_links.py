"""Links between documents, as the repository's web pages follow them. The site's are checked when it is built."""

import re

import pytest
from documents import DOCUMENTS, ROOT

PAGES = {
    **DOCUMENTS,
    "CONTRIBUTING.md": ROOT / "CONTRIBUTING.md",
    "experiments/results/README.md": ROOT / "experiments" / "results" / "README.md",
}


def anchors(path):
    """What headings are called in links."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    path = PAGES[name]
    text = re.sub(r"```.*?```|`[^`\n]*`", "", path.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        assert there.exists() and there.is_relative_to(ROOT), f"{name}: {target}"
        assert not anchor or anchor in anchors(there), f"{name}: {target}"
