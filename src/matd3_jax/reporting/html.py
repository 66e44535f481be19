"""HTML in which every text is escaped: what comes from a run directory cannot become markup."""

import base64
import html
from pathlib import Path

TYPES = {".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}
VOID = ("br", "col", "img", "meta", "source")


class Markup(str):
    """Finished HTML."""


def tag(name: str, /, *children: "str | Markup | None", **attributes: object) -> Markup:
    """An element. Children that are not `Markup` are texts, and escaped, as attributes are; None is left out.

    Attributes are written with `_` for `-`, and `class_` for `class`; one that is None or False is left out, and True
    has no value.
    """
    given = []
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        given.append(f" {key}" if value is True else f' {key}="{escape(str(value))}"')
    opened = f"<{name}{''.join(given)}>"
    return Markup(opened if name in VOID else f"{opened}{join(*children)}</{name}>")


def join(*children: "str | Markup | None") -> Markup:
    """Children of an element one after the other."""
    return Markup("".join(c if isinstance(c, Markup) else escape(c) for c in children if c is not None))


def escape(text: str) -> Markup:
    """A text as HTML; what no page may hold (control characters, halves of pairs) is written as its Python escape."""
    shown = "".join(
        letter if letter.isprintable() or letter in "\n\t" else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )
    return Markup(html.escape(shown, quote=True))


def data_uri(path: Path) -> str:
    """A picture or film as a URI that holds it."""
    return f"data:{TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def table(heads: "list[str | Markup]", rows: "list[list[str | Markup]]", class_: str | None = None) -> Markup:
    """A table whose first column names the rows; cells that are `Markup` may be whole cells (`number`)."""

    def cell(content: "str | Markup", first: bool) -> Markup:
        if isinstance(content, Markup) and content.startswith(("<td", "<th")):
            return content
        return tag("th", content, scope="row") if first else tag("td", content)

    head = tag("thead", tag("tr", *(tag("th", one, scope="col") for one in heads)))
    body = tag("tbody", *(tag("tr", *(cell(one, k == 0) for k, one in enumerate(row))) for row in rows))
    return tag("div", tag("table", head, body, class_=class_), class_="scroll")


def number(text: str, value: float | None = None) -> Markup:
    """A cell with a number, to the right; the whole of it, for who reads the page by a program, is in data-value."""
    return tag("td", text, class_="number", data_value=None if value is None else repr(float(value)))
