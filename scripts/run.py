"""The same as ``marl-handover run [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["run", *sys.argv[1:]]))
