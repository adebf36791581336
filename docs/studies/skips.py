"""Measures what each skip of the physics saves: kernels without it take turns with those that have all.

Run: python -m docs.studies.skips --scene bimanual_psm_needle --task needle_handover --motion grasp
"""

from __future__ import annotations

from docs.studies.passes import measure, parsed, report
from surgical_marl.physics.skip import SKIPS, VARIABLE


def main(argv: list[str] | None = None) -> None:
    """Print a row for each skip."""
    a, workload = parsed(__doc__, argv)
    names = a.only or list(SKIPS)
    report("skip", measure(workload, names, a.repeats, VARIABLE, a.processes), workload)


if __name__ == "__main__":
    main()
