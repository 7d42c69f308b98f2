"""A sampling planner, RRT-Connect of OMPL (extra ``[ompl]``): a fallback for the optimiser, and a witness that a way exists.

What it finds is a polyline, made short by cutting corners; it knows nothing of lift-over or of smoothness. J. Kuffner, S. LaValle,
"RRT-Connect: An Efficient Approach to Single-Query Path Planning", ICRA 2000.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.config import require_positive, require_seed
from marl_handover.errors import InvalidSetting, NotFinite, WorkFailed, install_line

Floats = NDArray[np.float64]

STEP_RAD = 0.01
"""Motions are checked at joint vectors at most this far apart: a grip 300 mm away then moves by 3 mm or less."""


class OmplMissing(WorkFailed):
    """OMPL is not installed."""

    def __init__(self) -> None:
        super().__init__(f"the sampling planner needs OMPL; run: {install_line('ompl')}")


def rrt_connect(
    start_q: ArrayLike,
    goal_q: ArrayLike,
    is_valid: Callable[[Floats], bool],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    seconds: float,
    seed: int,
) -> Floats | None:
    """A valid way between two joint vectors.

    Args:
        start_q: (joints,) in rad.
        goal_q: (joints,) in rad.
        is_valid: whether a joint vector (joints,) is free of collisions; called many times.
        lower: least joint values (joints,); a joint whose two limits are equal is left out of the search.
        upper: greatest joint values (joints,).
        seconds: time after which the search gives up; making the way shorter comes on top.
        seed: one seed, one way. The search shares OMPL's one generator, which this sets: plan from one thread at a time.

    Returns:
        Corners (k, joints) of a way whose straight pieces are valid every :data:`STEP_RAD`, exactly from start to goal, or None if none was
        found: no proof that there is none, unless start or goal itself is invalid.

    Raises:
        OmplMissing: without OMPL.
        NotFinite, InvalidSetting: a joint vector is not finite or outside the limits, or shapes, ``seconds`` or ``seed`` are wrong.
    """
    start, goal, low, high = _checked(start_q, goal_q, lower, upper)
    require_positive("seconds", seconds)
    require_seed(seed)
    try:
        from ompl import util
    except ImportError as error:
        raise OmplMissing from error
    before = util.getLogLevel()
    util.setLogLevel(util.LOG_NONE)  # OMPL reports every solution, and complains of a second seed, which it takes nonetheless
    try:
        util.RNG.setSeed(seed + 1)  # it ignores 0
        return _search(start, goal, is_valid, low, high, seconds)
    finally:
        util.setLogLevel(before)


def _checked(start_q: ArrayLike, goal_q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
    start, goal, low, high = (np.array(values, dtype=float) for values in (start_q, goal_q, lower, upper))
    for name, values in (("start_q", start), ("goal_q", goal), ("lower", low), ("upper", high)):
        if values.ndim != 1 or values.shape != start.shape:
            raise InvalidSetting(name, values.shape, f"an array of shape {start.shape}" if start.ndim == 1 else "an array (joints,)")
        if not np.isfinite(values).all():
            raise NotFinite(name, values.tolist())
    if (low > high).any():
        raise InvalidSetting("lower", low.tolist(), f"at most the upper limits, {high.tolist()}")
    for name, values in (("start_q", start), ("goal_q", goal)):
        if (values < low).any() or (values > high).any():
            raise InvalidSetting(name, values.tolist(), f"between {low.tolist()} and {high.tolist()}")
    return start, goal, low, high


def _search(start: Floats, goal: Floats, is_valid: Callable[[Floats], bool], low: Floats, high: Floats, seconds: float) -> Floats | None:
    from ompl import base, geometric

    if not (is_valid(start) and is_valid(goal)):
        return None
    searched = np.flatnonzero(low < high)
    if not len(searched):
        return np.stack([start, goal])
    space = base.RealVectorStateSpace(len(searched))
    bounds = base.RealVectorBounds(len(searched))
    for k, joint in enumerate(searched):
        bounds.setLow(k, float(low[joint]))
        bounds.setHigh(k, float(high[joint]))
    space.setBounds(bounds)

    def joints_of(state: base.State) -> Floats:
        q = start.copy()
        q[searched] = [state[k] for k in range(len(searched))]
        return q

    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: bool(is_valid(joints_of(state))))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(min(1.0, STEP_RAD / float(np.linalg.norm(high - low))))
    ends = [space.allocState(), space.allocState()]
    for state, q in zip(ends, (start, goal), strict=True):
        for k, joint in enumerate(searched):
            state[k] = float(q[joint])
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(information))
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        return None
    way = setup.getSolutionPath()
    geometric.PathSimplifier(information).simplifyMax(way)
    corners = np.stack([joints_of(way.getState(i)) for i in range(way.getStateCount())])
    corners[0], corners[-1] = start, goal
    return corners
