"""Run the command `surgical-marl`; `python -m surgical_marl` is the same, and torchrun starts it in this way.

An example (see docs/scaling.md):

    torchrun --nproc-per-node 4 -m surgical_marl train reach --scene psm
"""

import sys

from surgical_marl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
