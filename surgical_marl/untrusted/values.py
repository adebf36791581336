"""Values that somebody wrote: as numbers within limits, and short enough for a sentence."""

from __future__ import annotations

import math
import numbers
import reprlib
from collections.abc import Iterable
from itertools import islice
from typing import Any

LARGEST = 1e9
"""The largest number that any file may hold, either sign. Products of a few of them still fit into float32."""
LEAST = 1e-12
"""The least of a number that must be above 0."""
LONGEST, SHORTEST = 1000.0, 1e-6
"""Lengths in m: the largest of any coordinate or side, and the smallest side. Angles have the same largest number."""
_DIGITS = 40
_TEXT = 200


def as_number(value: Any, words: bool = False) -> float:
    """Return a value as a float; NaN if it is no number, and infinity if it is a whole number that no float can hold.

    Args:
        value: anything.
        words: whether a text may be a number: numbers of an XML file are texts.
    """
    if isinstance(value, bool) or not isinstance(value, (numbers.Real, str) if words else numbers.Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf  # type: ignore[operator]
    except ValueError:
        return math.nan


def shown(value: Any) -> str:
    """Return a value as Python writes it, in at most 200 characters, whatever its size and depth."""
    text = _SHORT.repr(value)
    return text if len(text) <= _TEXT else text[: _TEXT - 3] + "..."


def one_line(value: Any, most: int = _TEXT) -> str:
    """Return a text as one line that a terminal can show, in at most `most` characters: other characters as escapes."""
    text = "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in str(value)[:most]
    )
    return text if len(text) <= most else text[: most - 3] + "..."


def listed(names: Iterable[Any], most: int = 40) -> str:
    """Return names with commas between them, the first `most` of them, and then how many more there are."""
    left = iter(names)
    first = [one_line(name) for name in islice(left, most)]
    more = sum(1 for _ in left)
    return ", ".join(first) + (f" and {more:,} more" if more else "")


def plural(count: float, noun: str) -> str:
    """Return a regular noun as it stands after a count: "frame" after 1, "frames" after any other."""
    return noun if count == 1 else f"{noun}s"


def check_count(count: int, most: int, what: str, where: object) -> None:
    """Raise ValueError if there are more than `most` of something."""
    if count > most:
        raise ValueError(f"{where}: {count:,} {what} are too many; at most {most:,} are read")


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 5
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 20
        self.maxstring = self.maxother = 80

    def repr_str(self, value: str, level: int) -> str:
        """Keep the beginning."""
        return repr(value if len(value) <= self.maxstring else value[: self.maxstring - 3] + "...")

    def repr_int(self, value: int, level: int) -> str:
        """Say how long a number is that is not written out. Python does not write out any number."""
        digits = int(value.bit_length() * math.log10(2)) + 1
        if digits <= _DIGITS:
            return repr(value)
        first = abs(value) // 10 ** (digits - 6)
        return f"{'-' if value < 0 else ''}{str(first)[:5]}... (a whole number of {digits} digits)"

    def repr_dict(self, value: dict[Any, Any], level: int) -> str:
        """Keep the order."""
        if level <= 0:
            return "{...}"
        parts = [
            f"{self.repr1(k, level - 1)}: {self.repr1(v, level - 1)}" for k, v in islice(value.items(), self.maxdict)
        ]
        return "{" + ", ".join(parts + ["..."] * (len(value) > self.maxdict)) + "}"


_SHORT = _Short()
