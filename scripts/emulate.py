"""The same as ``marl-handover emulate [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["emulate", *sys.argv[1:]]))
