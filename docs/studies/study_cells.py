"""The cells of the study: what is trained, grouped by the question that they answer together."""

from __future__ import annotations

from typing import NamedTuple

from surgical_marl.content import unknown


class Cell(NamedTuple):
    """One thing that is trained with several seeds."""

    name: str
    question: str
    """A key of `QUESTIONS`: cells of one question are compared with one another."""
    task: str
    scene: str
    settings: tuple[str, ...]
    """`key=value`, beside those of the task's file."""

    def label(self) -> str:
        """Return what tells the cell from others of its question: its settings."""
        return " ".join(text for text in self.settings if not text.startswith("team_reward"))


QUESTIONS = {
    "free": "Arms with goals of their own",
    "messages": "One arm knows the goals of all",
    "critic": "An object that passes from arm to arm",
    "memory": "Arms that know nothing of each other",
}
"""The questions by their keys, as headings of docs/study.md."""

_ONE = ("knowledge=one", "team_reward=true")


def _cells(
    question: str, start: str, task: str, scene: str, common: tuple[str, ...], *each: tuple[str, ...]
) -> list[Cell]:
    """Return a cell for each choice of settings beside the common ones, named by what was chosen."""
    named = [("-".join((start, *(text.partition("=")[2] for text in own))), own) for own in each]
    return [Cell(name, question, task, scene, (*common, *own)) for name, own in named]


CELLS = {
    cell.name: cell
    for cell in [
        *_cells("free", "reach-bimanual_psm", "reach", "bimanual_psm", (),
                ("algo=mappo",), ("algo=ippo",), ("algo=joint",), ("algo=happo",)),
        *_cells("free", "reach-bimanual_star", "reach", "bimanual_star", (),
                ("algo=mappo",), ("algo=ippo",), ("algo=joint",)),
        *_cells("free", "reach-trimanual_psm_ecm", "reach", "trimanual_psm_ecm", (),
                ("algo=mappo",), ("algo=ippo",), ("algo=joint",)),
        *_cells("messages", "one", "reach", "bimanual_psm", _ONE,
                ("messages=0", "algo=mappo"), ("messages=4", "algo=mappo"), ("messages=4", "algo=ippo")),
        *_cells("critic", "handover", "needle_handover", "bimanual_psm_needle", (),
                ("algo=mappo",), ("algo=ippo",), ("algo=joint",), ("algo=happo",)),
        *_cells("memory", "own", "reach", "bimanual_psm", ("knowledge=own",),
                ("network.recurrent=none",), ("network.recurrent=gru",)),
    ]
}  # fmt: skip
"""All cells by name."""

ON_A_CPU = ("one-0-mappo", "one-4-mappo")
"""Cells that a CPU trains in minutes a seed. Those of `needle_handover` need a GPU; docs/study.md says how long."""


def find_cell(name: str) -> Cell:
    """Return the cell of that name; ValueError if there is none."""
    if name not in CELLS:
        raise unknown("cell", name, list(CELLS))
    return CELLS[name]
