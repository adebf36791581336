"""`python -m surgical_marl` is the command `surgical-marl`; so starts it torchrun (docs/scaling.md):

torchrun --nproc-per-node 4 -m surgical_marl train reach --scene psm
"""

import sys

from surgical_marl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
