"""The same as ``marl-handover robot [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["robot", *sys.argv[1:]]))
