"""Scenes of tests."""

from pathlib import Path

APART = str(Path(__file__).parent / "apart.yaml")
"""Arms of two kinds that never touch, in no order of their names."""
WATCHED = str(Path(__file__).parent / "watched.yaml")
"""A PSM, tissue, and an ECM that sees them."""
PAIR = str(Path(__file__).parent / "pair.yaml")
"""Two ECMs that never touch: the cheapest team."""
