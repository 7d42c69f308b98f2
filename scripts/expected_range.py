"""What a training may bring, beside what one has brought: ``python scripts/expected_range.py EVALUATION.json ROW``.

ROW is one of ``suite=seeds``, whose stored runs say what to expect.
"""

import sys
from pathlib import Path

from marl_handover.errors import HandoverError
from marl_handover.experiments.tables import expected_lines
from marl_handover.parsing import read_json

STORED = Path(__file__).resolve().parents[1] / "bench" / "results" / "compare" / "seeds" / "results.json"

if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    if not STORED.is_file():
        sys.exit(f"what to expect has not been measured: {STORED} is missing")
    try:
        found = read_json(Path(sys.argv[1]), "evaluation")
        print("\n".join(expected_lines(read_json(STORED, "stored results"), sys.argv[2], found)))
    except HandoverError as error:
        sys.exit(str(error))
