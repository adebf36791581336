"""Write the URDF of every shipped arm into its folder: `python arms/build`."""

from __future__ import annotations

from pathlib import Path

import ecm
import psm
import star

ARMS = Path(__file__).resolve().parents[1]


def texts() -> dict[str, str]:
    """The text of every arm's URDF by the arm's name."""
    return psm.build() | ecm.build() | star.build()


def main() -> None:
    """Writes them."""
    for name, text in texts().items():
        path = ARMS / name / f"{name}.urdf"
        path.write_text(text, encoding="utf-8", newline="\n")
        print(path)


if __name__ == "__main__":
    main()
