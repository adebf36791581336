"""Texts that somebody wrote, such as names and descriptions, in HTML and in Markdown: there they stay texts.

A page shows what a file says, and no more: no text becomes a tag, a link, a heading or a row of a table.
"""

from __future__ import annotations

import html
import re
import shlex
import unicodedata
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from surgical_marl.untrusted.values import shown

if TYPE_CHECKING:
    import jinja2

_SPECIAL = re.compile(r"(?<![^\W_])_|_(?![^\W_])|[\\`*\[\]<>|~$&]")
"""Characters that Markdown would read as more than a letter; an underline within a word is a letter."""
_NO_NAME = ("Cc", "Cs", "Zl", "Zp")
"""Categories of Unicode: control characters, bytes that are no text, ends of lines and paragraphs."""


def as_html(text: Any) -> str:
    """Return a text for HTML, between tags or within quotes of an attribute. Bytes that are no text become "?"."""
    return html.escape(whole(text))


def as_markdown(text: Any) -> str:
    """Return a text for a line of Markdown, in a table too."""
    return _SPECIAL.sub(lambda found: "\\" + found[0], _line(text))


def as_code(text: Any) -> str:
    """Return a text as code within a line of Markdown, in a table too."""
    line = _line(text).replace("|", "\\|") or " "
    longest = max(map(len, re.findall("`+", line)), default=0)
    fence, room = "`" * (longest + 1), " " if longest else ""
    return f"{fence}{room}{line}{room}{fence}"


def as_link(name: str) -> str:
    """Return a Markdown link to a file or folder beside the page."""
    return f"[{as_markdown(name)}]({quote(whole(name), safe='')})"


def whole(text: Any) -> str:
    """Return a text that can be written in UTF-8: "?" stands for each byte of a file's name that is no text."""
    return str(text).encode(errors="replace").decode()


def template(path: Path) -> jinja2.Template:
    """Return a template of Jinja. In an .html file it escapes everything that is not `Markup`.

    Filters are `md` and `code`, for texts in Markdown as `as_markdown` and `as_code` return them, and `shell` for a
    word of a command line. A name that a template reads and nobody gave is an error.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=path.suffix == ".html",
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"md": as_markdown, "code": as_code, "shell": shlex.quote}
    return environment.from_string(path.read_text(encoding="utf-8"))


def check_name(name: str, what: str) -> None:
    """Raise ValueError if a name holds characters that menus and terminals do not show: controls, ends of lines."""
    bad = next((letter for letter in name if unicodedata.category(letter) in _NO_NAME), None)
    if bad is not None:
        raise ValueError(f"the name of {what}, {shown(name)}, holds {bad!a}, which can't be shown: give it another one")


def _line(text: Any) -> str:
    """Return a text as one line without control characters."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in whole(text)).split())
