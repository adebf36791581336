"""YAML 1.2 as people write it: what each word means, and where in a file something is wrong."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import surgical_marl
from surgical_marl.yaml_file import dump_yaml, load_yaml, merged, parse_yaml


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("1e-3", 1e-3), ("3443e-7", 3443e-7), ("1.0e-3", 1e-3), ("1E+3", 1e3), (".5", 0.5), ("-5.e1", -50.0),
        ("010", 10), ("-08", -8), ("0o10", 8), ("0x1F", 31), ("+1", 1), ("1_0", "1_0"), ("1:30", "1:30"), ("1e", "1e"),
        (".inf", math.inf), ("-.INF", -math.inf), (".", "."), ("0b1", "0b1"), ("0o8", "0o8"),
        ("true", True), ("FALSE", False), ("yes", "yes"), ("on", "on"), ("tRUE", "tRUE"), ("~", None), ("Null", None),
        ("''", ""), ("'1'", "1"), ('"true"', "true"), ("2001-01-01", "2001-01-01"), ("<<", "<<"), ("=", "="),
    ],
)  # fmt: skip
def test_words_mean_what_yaml_1_2_says(written: str, meant: Any) -> None:
    found = parse_yaml(f"k: {written}")["k"]
    assert found == meant and type(found) is type(meant)


def test_a_key_is_a_text_as_it_is_written() -> None:
    assert parse_yaml("{1: a, on: b, 010: c, '1e3': d, ~: e}") == {
        "1": "a",
        "on": "b",
        "010": "c",
        "1e3": "d",
        "~": "e",
    }


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("arms:\n  psm_0: 1\n  psm_1: 2\n  psm_0: 3\n", 4, "the key 'psm_0' is given twice, first in line 2"),
        ("a: 1\n'a': 2\n", 2, "the key 'a' is given twice, first in line 1"),
        ("a: 1\n---\nb: 2\n", 2, "a second document begins"),
        ("a: 1\n b: 2\n", 2, "mapping values are not allowed"),
        ("a: [1,\nb: [2\n", 3, "did not find expected"),
        ("a:\n- b\n- *c\n", 3, "an alias"),
        ("a: 1\nb: !!float 2\n", 2, "the tag 'tag:yaml.org,2002:float'"),
        ("a: 1\n? [b]\n: 2\n", 2, "a key must be a text"),
        ("é: 1\nb: \x07\n", 2, r"'\x07' is a character that no text has"),
        (f"a: 1\nb: {'9' * 101}\n", 2, "101 characters; write at most 100"),
    ],
)
def test_what_is_no_yaml_is_one_sentence(tmp_path: Path, text: str, line: int, words: str) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(ValueError) as caught:
        load_yaml(path)
    sentence = str(caught.value)
    assert (
        sentence.startswith(f"{path}, line {line} is not valid YAML: ") and words in sentence and "\n" not in sentence
    )


def test_lines_of_keys_and_parts() -> None:
    found = parse_yaml("# first\na: 1\n\nb:\n  - 2\n  - {c: 3,\n     d: 4}\n")
    assert found.lines == {"a": 2, "b": 4}
    assert found["b"].lines == {0: 5, 1: 6} and found["b"][1].lines == {"c": 6, "d": 7}


@pytest.mark.parametrize(
    ("base", "patch", "result"),
    [  # those of RFC 7396, appendix A, that are mappings
        ("{a: b}", "{a: c}", {"a": "c"}),
        ("{a: b}", "{b: c}", {"a": "b", "b": "c"}),
        ("{a: b}", "{a: null}", {}),
        ("{a: b, b: c}", "{a: null}", {"b": "c"}),
        ("{a: [b]}", "{a: c}", {"a": "c"}),
        ("{a: c}", "{a: [b]}", {"a": ["b"]}),
        ("{a: {b: c}}", "{a: {b: d, c: null}}", {"a": {"b": "d"}}),
        ("{a: [{b: c}]}", "{a: [1]}", {"a": [1]}),
        ("{e: null}", "{a: 1}", {"e": None, "a": 1}),
        ("{}", "{a: {bb: {ccc: null}}}", {"a": {"bb": {}}}),
    ],
)
def test_a_merge_patch_is_that_of_rfc_7396(base: str, patch: str, result: Any) -> None:
    one, other = parse_yaml(base), parse_yaml(f"\n{patch}")
    found = merged(one, other)
    assert found == result and one == parse_yaml(base)
    assert found.lines == {key: 2 if key in other else 1 for key in result}


plain = st.none() | st.booleans() | st.integers(-(10**40), 10**40) | st.floats(allow_nan=False)
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Cn", "Co")), max_size=8)
numbers = st.from_regex(r"[-+.0-9xobeE_:]{1,6}", fullmatch=True)
values = st.recursive(
    plain | words | numbers,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words.filter(bool) | numbers, inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None)
@given(values, st.booleans())
def test_what_is_written_is_read_again(value: Any, flow: bool) -> None:
    assert parse_yaml(dump_yaml({"k": value}, flow)) == {"k": value}


def test_only_one_module_reads_yaml() -> None:
    """So that a word means the same in every file."""
    package = Path(surgical_marl.__file__).parent
    found = [
        path.name for path in package.rglob("*.py") if re.search(r"^\s*(import|from) yaml\b", path.read_text(), re.M)
    ]
    assert found == ["yaml_file.py"]
