"""Put the results of suites into docs/results.md: ``python scripts/results_docs.py [OUT ...]``.

Each OUT, the folder of a finished ``marl-handover compare``, is stored as evidence under bench/results/compare first.
"""

import sys
from pathlib import Path

from marl_handover.compare.docs import filled, read_evidence, store_evidence

ROOT = Path(__file__).resolve().parents[1]
EVIDENCE, PAGE, PICTURES = ROOT / "bench" / "results" / "compare", ROOT / "docs" / "results.md", "../bench/results/compare"

if __name__ == "__main__":
    for out in sys.argv[1:]:
        print(f"stored: {store_evidence(Path(out), EVIDENCE)}")
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), read_evidence(EVIDENCE), PICTURES), encoding="utf-8")
    print(f"written: {PAGE}")
