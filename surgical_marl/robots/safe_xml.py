"""Reads untrusted XML with defusedxml, which refuses entities and references to other files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder, tostring

MAX_DEPTH = 256
"""Greatest depth of nested elements; libxml2 has the same limit."""
MAX_ELEMENTS = 50_000
"""Elements of a document; each takes a thousand bytes."""


class Document(NamedTuple):
    """An XML document without a DOCTYPE."""

    root: Element
    lines: dict[Element, int]
    """The line on which each element starts."""


def parse_xml(data: bytes, path: Path, noun: str) -> Document:
    """Parse XML without a DOCTYPE. Only a DOCTYPE can define entities or name other files.

    Args:
        data: the text.
        path: for the message.
        noun: what the file should be, for the message.

    Raises:
        ValueError: a DOCTYPE, an encoding that is not read, elements nested too deeply, or no XML.
    """
    from defusedxml.common import DTDForbidden
    from defusedxml.ElementTree import DefusedXMLParser, ParseError

    builder = _Lines()
    builder.expat = (parser := DefusedXMLParser(target=builder, forbid_dtd=True)).parser
    try:
        parser.feed(data)
        return Document(parser.close(), builder.lines)
    except DTDForbidden:
        raise ValueError(f"{path} has a DOCTYPE, which can define entities; remove it") from None
    except (ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{path} is not a {noun} that can be read: {error}") from None


def write_xml(root: Element) -> bytes:
    """Return the text of an element.

    Other parsers are given this text in place of the file's own text. They may know encodings that defusedxml does not,
    and read something in the file's own text that defusedxml did not see.
    """
    return tostring(root)


class _Lines(TreeBuilder):
    """Builds a tree of limited depth and keeps the line of each element."""

    expat: Any

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[Element, int] = {}
        self._depth = 0

    def start(self, tag: Any, attributes: Any, /) -> Element:
        line = self.expat.CurrentLineNumber
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"elements are nested deeper than {MAX_DEPTH}: line {line}")
        if len(self.lines) == MAX_ELEMENTS:
            raise ValueError(f"more than {MAX_ELEMENTS:,} elements are not read: line {line}")
        element = super().start(tag, attributes)
        self.lines[element] = line
        return element

    def end(self, tag: Any, /) -> Element:
        self._depth -= 1
        return super().end(tag)
