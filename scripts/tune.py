"""The same as ``marl-handover tune [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["tune", *sys.argv[1:]]))
