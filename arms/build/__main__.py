"""Write the URDFs of every shipped arm into its folder: `python arms/build`."""

from __future__ import annotations

from pathlib import Path

import ecm
import psm
import star

ARMS = Path(__file__).resolve().parents[1]


def texts() -> dict[str, str]:
    """The text of every URDF, by the name of its file in `arms/`."""
    return psm.build() | ecm.build() | star.build()


def main() -> None:
    """Writes them."""
    for name, text in texts().items():
        path = ARMS / name
        path.write_text(text, encoding="utf-8", newline="\n")
        print(path)


if __name__ == "__main__":
    main()
