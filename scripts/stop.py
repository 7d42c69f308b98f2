"""The same as ``marl-handover stop [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["stop", *sys.argv[1:]]))
