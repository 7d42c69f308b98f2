"""Put the results of suites into the pages that show them: ``python scripts/results_docs.py [partial=true] [OUT ...]``.

Each OUT, the folder of a finished ``marl-handover compare``, is stored as evidence under bench/results/compare first. With ``partial=true``
one that does not have all rows and seeds yet is taken, too, and the page says so.
"""

import sys
from pathlib import Path

from marl_handover.errors import HandoverError
from marl_handover.experiments.tables import filled, read_evidence, store_evidence
from marl_handover.files import write_whole

ROOT = Path(__file__).resolve().parents[1]
EVIDENCE, PICTURES = ROOT / "bench" / "results" / "compare", "../bench/results/compare"
PAGES = tuple(ROOT / "docs" / name for name in ("results.md", "engines.md", "benchmark.md"))
PARTIAL = "partial=true"

if __name__ == "__main__":
    try:
        for out in (argument for argument in sys.argv[1:] if argument != PARTIAL):
            print(f"stored: {store_evidence(Path(out), EVIDENCE, partial=PARTIAL in sys.argv[1:])}")
        for page in PAGES:
            write_whole(page, filled(page.read_text(encoding="utf-8"), read_evidence(EVIDENCE), PICTURES))
    except HandoverError as error:
        sys.exit(str(error))
    print(f"written: {', '.join(map(str, PAGES))}")
