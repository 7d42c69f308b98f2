"""Kinematics and distances are written once, in ``geometry/``: nothing else in the package looks like a copy of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import marl_handover

PACKAGE = Path(marl_handover.__file__).parent
INDEPENDENT = {"hardware/clearance.py"}
"""The safety filter's forward kinematics are its own on purpose; ``tests/hardware/test_clearance.py`` compares them with these."""

POLAR = "cell/cell.py"
"""``Cell.polar`` sees a batch of points from all bases at once, in numpy or torch; ``tests/cell/test_cell.py`` compares it."""

COPIES = {
    "forward kinematics, by summing pitches": r"cumsum\([^)\n]*\[[^\]]*1:(4)?\]|\[[^\]]*1:(4)?\]\.cumsum",
    "inverse kinematics of two links": r"/ \(2(\.0)? \* \w*(upper|length_1|l1)\w* \* \w*(fore|length_2|l2)\w*",
    "the nearest points of two lines": r"\b(determinant|denominator|denom)\b = \w+ \* \w+ - \w+ \* \w+",
    "a rotation about an axis": r"np\.array\(\[\[cos\w*, -sin\w*, 0|\[math\.cos\(\w+\), -math\.sin",
    "a base's direction, to turn points by hand": r"\bbases?(\[\w+\])?\.facing\b",
    "a base's position, taken apart": r"\bnp\.array\(\[base\.x_mm, base\.y_mm\]\)|base\.[xy]_mm [+-]",
    "the geometric Jacobian": r"np\.cross\(\w*ax[ei]s",
}
NAMES = re.compile(
    r"^ *def (fk|ik|jacobian|forward_kinematics)\(|^def (segment_distance|nearest|elbow_up|flat_pose|transform|rotation)\(", re.MULTILINE
)


def sources():
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if not name.startswith("geometry/") and name not in INDEPENDENT:
            yield name, path.read_text(encoding="utf-8")


@pytest.mark.parametrize("what", COPIES)
def test_no_copy_of(what):
    found = [f"{name}: {match.group(0)}" for name, text in sources() if name != POLAR for match in re.finditer(COPIES[what], text)]
    assert not found, f"{what} belongs to marl_handover.geometry"


def test_no_function_has_the_name_of_one_in_geometry():
    found = [f"{name}: {match.group(0)}" for name, text in sources() for match in NAMES.finditer(text)]
    assert not found


@pytest.mark.parametrize("what", sorted(COPIES))
def test_the_patterns_find_the_originals(what):
    """A pattern that finds nothing anywhere would guard nothing."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in (PACKAGE / "geometry").glob("*.py")}
    written = {
        "a base's direction, to turn points by hand": "cos, sin = base.facing",
        "a base's position, taken apart": "base.x_mm + radius",
        "a rotation about an axis": texts["se3.py"],
        "forward kinematics, by summing pitches": texts["closed_form.py"] + "np.cumsum(q[:, 1:4], axis=1)",
        "inverse kinematics of two links": texts["closed_form.py"],
        "the nearest points of two lines": texts["capsules.py"],
        "the geometric Jacobian": texts["closed_form.py"],
    }
    assert re.search(COPIES[what], written[what])
