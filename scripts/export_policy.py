"""Write a run's policy as a file that needs no torch: python scripts/export_policy.py RUN FILE.npz"""

import sys
from pathlib import Path

from marl_handover.errors import HandoverError
from marl_handover.learning.checkpoint import run_arrays, save_policy


def main() -> int:
    """Export, or say in one line why not."""
    if len(sys.argv) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        save_policy(Path(sys.argv[2]), run_arrays(Path(sys.argv[1])))
    except HandoverError as error:
        print(f"export_policy: {error}", file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
