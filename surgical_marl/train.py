"""`surgical-marl train` as a module, which is what torchrun starts (docs/scaling.md):

torchrun --nproc-per-node 4 -m surgical_marl.train reach --scene psm
"""

from __future__ import annotations

import sys

from surgical_marl.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
