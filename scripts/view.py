"""The same as ``marl-handover view [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["view", *sys.argv[1:]]))
