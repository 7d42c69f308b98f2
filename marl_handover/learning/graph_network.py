"""The network over hand-over graphs: what it is worth that an arm moves an object next, and where it best hands it over.

Written once for torch, which trains it, and numpy, which plays it; ``layers`` are functions by name, :func:`layer_sizes` says which. Arms
tell each other what they know by the angles that they offer: what arm j knows is turned by the middle of the interval before arm i reads
it, as if i carried the object (rotary message passing). So sums of angles along a chain of hand-overs need not be learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Array, namespace, select, taken, wrap
from marl_handover.task.graph_observation import ARCS, ARM_FIELDS, LOG_SCALE, PAIR_FIELDS

Layers = Mapping[str, Callable[[Array], Array]]

HARMONICS = 4
"""Multiples of an angle that the network sees, and that what arms tell each other is turned by."""

ARM_FEATURES = 12
"""Numbers that :func:`arm_features` says of an arm at an angle."""

MARGIN_SLOPE, FINISH_SLOPE = 4.0, 20.0
"""How steeply a margin goes from -1 to 1 where an error is epsilon, in units of epsilon. The steep one is for who decides to finish only:
what is to lead somewhere must not be flat.
"""

LOG_STD_RANGE = (-6.0, 1.0)
SCORE = 8.0
"""Scores of messages are cut off here."""

TINY = 1e-6
"""Intervals are not narrower than this, in rad, where something is divided by their half width."""


class GraphShape(NamedTuple):
    """What a network is made of.

    ``width`` of what it keeps of an arm, a multiple of 16; ``rounds`` of messages, all by the same layers; place ``components`` of an
    interval; ``slack``: whether it is told how far an angle is inside what lets the next arm finish.
    """

    width: int
    rounds: int
    components: int
    slack: bool


def stored_shape(stored: Mapping[str, Any]) -> GraphShape:
    """The shape that a policy file says. Raises :class:`ValueError` or :class:`TypeError` for one that cannot be."""
    shape = GraphShape(**stored)
    sizes = (shape.width, 16, 1024), (shape.rounds, 0, 64), (shape.components, 1, 64), (shape.slack, False, True)
    if any(type(value) is not type(least) or not least <= value <= most for value, least, most in sizes) or shape.width % 16:
        raise ValueError(f"no network has the shape {shape}"[:100])
    return shape


def layer_sizes(shape: GraphShape) -> dict[str, tuple[int, int]]:
    """Inputs and outputs of each layer."""
    width, told = shape.width, ARM_FEATURES + 2 * HARMONICS
    sizes = {
        "embed": (2 + 2 * HARMONICS, width),
        "message": (2 * width + 4 + 2 * HARMONICS, width),
        "message_out": (width, width + 1),
        "revise": (2 * width + 1, width),
        "revise_out": (width, width),
        "finish": (ARM_FEATURES + 1, 32),
        "finish_hidden": (32, 32),
        "finish_out": (32, 1),
        "place": (2 * width + ARM_FEATURES + told + 5, width),
        "place_hidden": (width, width),
        "place_out": (width, 2 * shape.components),
    }
    for twin in range(2):
        sizes |= {f"value_{twin}": (width + told, width), f"value_{twin}_hidden": (width, width), f"value_{twin}_out": (width, 1)}
    return sizes


class HandoverGraphs:
    """The graphs of a batch of problems, joined: arms of all problems in one list, and intervals of hand-over angles, giver by giver.

    Attributes:
        count, num_arms: problems, and arms that each has room for.
        problem, arm: (A,) whose arm each is, and its number there.
        reaches_object, was_previous: bool (A,); reaches_goal (A,) 0 or 1; angle, goal_angle, epsilon (A,) in rad.
        giver, receiver: (E,) rows of arms; arc (E,) which of the pair's intervals.
        middle, half: (E,) of the interval, in rad.
        outgoing: (A, D) rows of intervals that an arm gives over, -1 for none.
    """

    def __init__(self, observation: Array, num_arms: int) -> None:
        xp = namespace(observation)
        self.count, self.num_arms = len(observation), num_arms
        cut = num_arms * len(ARM_FIELDS)
        arms = observation[:, :cut].reshape(-1, num_arms, len(ARM_FIELDS))
        pairs = observation[:, cut:].reshape(-1, num_arms, num_arms, ARCS, len(PAIR_FIELDS) // ARCS)
        self.problem, self.arm = _nonzero(arms[..., 0] > 0)
        there = arms[self.problem, self.arm]
        self.reaches_object, self.was_previous = there[:, 1] > 0, there[:, 3] > 0
        self.reaches_goal, self.angle, self.goal_angle = there[:, 2], math.pi * there[:, 4], math.pi * there[:, 5]
        self.epsilon = xp.exp(LOG_SCALE * there[:, 6])
        row = xp.full(arms.shape[:2], -1, dtype=xp.int64, **_on(arms))
        row[self.problem, self.arm] = xp.arange(len(there), **_on(arms))
        of, i, j, self.arc = _nonzero(pairs[..., 1] >= 0)
        self.giver, self.receiver = row[of, i], row[of, j]
        self.middle, self.half = (math.pi * pairs[of, i, j, self.arc, number] for number in range(2))
        degree = xp.bincount(self.giver, minlength=len(there))
        first = xp.cumsum(degree, 0) - degree
        number = xp.arange(len(self.giver), **_on(self.giver))
        self.outgoing = xp.full((len(there), int(degree.max()) if len(there) else 0), -1, dtype=number.dtype, **_on(row))
        self.outgoing[self.giver, number - first[self.giver]] = number

    def with_mirror(self) -> HandoverGraphs:
        """The graphs, and after them those of the mirrored problems."""
        xp = namespace(self.angle)
        other: HandoverGraphs = object.__new__(HandoverGraphs)
        other.__dict__ |= self.__dict__
        for name in ("reaches_goal", "epsilon", "half"):
            setattr(other, name, xp.concat(2 * [getattr(self, name)]))
        for name in ("angle", "goal_angle", "middle"):
            setattr(other, name, xp.concat([getattr(self, name), -getattr(self, name)]))
        arms, edges = len(self.arm), len(self.giver)
        other.giver, other.receiver = (xp.concat([rows, rows + arms]) for rows in (self.giver, self.receiver))
        other.outgoing = xp.concat([self.outgoing, xp.where(self.outgoing < 0, -1, self.outgoing + edges)])
        return other

    def hopeless(self) -> Array:
        """Problems (n,) in which no arm that reaches the goal can ever be handed the object: bool."""
        xp, shape = namespace(self.angle), (self.count, self.num_arms)
        passes = xp.zeros((*shape, self.num_arms), dtype=xp.float32, **_on(self.angle))
        passes[self.problem[self.giver], self.arm[self.giver], self.arm[self.receiver]] = 1.0
        carries, finishes = (xp.zeros(shape, dtype=xp.float32, **_on(self.angle)) for _ in range(2))
        carries[self.problem, self.arm] = 1.0 * self.reaches_object
        finishes[self.problem, self.arm] = 1.0 * self.reaches_goal
        for _ in range(self.num_arms - 1):
            carries = xp.clip(carries + (carries[:, None] @ passes)[:, 0], 0, 1)
        return (carries * finishes).sum(-1) == 0

    def summed(self, values: Array) -> Array:
        """Sums (A, ...) over the intervals that each arm gives over, of ``values`` (E, ...)."""
        xp = namespace(values)
        if xp is np:
            return np.concatenate([values, np.zeros_like(values[:1])])[self.outgoing].sum(1)
        return xp.zeros(len(self.angle), *values.shape[1:], **_on(values)).index_add(0, self.giver, values)


def embedded(layers: Layers, shape: GraphShape, graph: HandoverGraphs) -> Array:
    """What the network keeps of every arm, (A, width): of goal, epsilon and layout, not of where the object is."""
    xp = namespace(graph.angle)
    reach, goal = graph.reaches_goal[:, None], _harmonics(graph.goal_angle)
    embedding = layers["embed"](xp.concat([reach, xp.log(graph.epsilon)[:, None], reach * goal], -1))
    half, turn = graph.half[:, None], _harmonics(graph.middle)
    there = reach[graph.receiver]
    fixed = xp.concat([half, xp.cos(half), xp.sin(half), there, there * _harmonics(graph.goal_angle[graph.receiver] - graph.middle)], -1)
    for _ in range(shape.rounds):
        told = xp.concat([embedding[graph.giver], _turned_back(embedding[graph.receiver], turn), fixed], -1)
        message = layers["message_out"](_positive(layers["message"](told)))
        weight = xp.exp(_clipped(message[:, -1:], -SCORE, SCORE))
        total = graph.summed(weight) + 1e-6
        heard = graph.summed(weight * _positive(message[:, :-1])) / total
        update = layers["revise"](xp.concat([embedding, heard, xp.log(total) / 4], -1))
        embedding = _normalised(embedding + layers["revise_out"](_positive(update)))
    return embedding


def arm_features(graph: HandoverGraphs, arm: Array, angle: Array, slack: bool = True) -> Array:
    """What can be told of rows of arms (...) that carry the object at angles (...) [rad]: (..., :data:`ARM_FEATURES`).

    Whether the arm reaches the goal, how well it would finish, and how far inside (above 0) or outside the angle is of those that let the
    arm hand over to one that finishes.
    """
    xp = namespace(angle)
    reach, epsilon, error = graph.reaches_goal[arm], graph.epsilon[arm], wrap(angle - graph.goal_angle[arm])
    away = onward(graph, arm, angle)[0] if slack else 0 * angle
    features = [
        reach,
        reach * (1 + _clipped(MARGIN_SLOPE * (1 - abs(error) / epsilon), -1, 1)) - 1,
        reach * _clipped(error / epsilon / 4, -1, 1),
        away / math.pi,
        _clipped(away / epsilon / 4, -1, 1),
        xp.log(epsilon),
    ]
    return xp.concat([xp.stack(features, -1), reach[..., None] * _harmonics(error, 3)], -1)


def onward(graph: HandoverGraphs, arm: Array, angle: Array) -> tuple[Array, Array]:
    """How far rows of arms (...) at angles (...) are inside the nearest interval over which they can hand to an arm that then finishes.

    The slack in rad, -pi for no such interval, and how the angle would have to change to get there, 0 inside.
    """
    xp = namespace(angle)
    edge = graph.outgoing[arm]
    receiver = graph.receiver[edge]
    offers = (edge >= 0) & (graph.reaches_goal[receiver] > 0)
    missing = wrap(graph.goal_angle[receiver] - angle[..., None] - graph.middle[edge])
    slack = xp.where(offers, graph.half[edge] - abs(missing), 0 * missing - math.pi)
    best = xp.argmax(slack, -1)
    slack, missing = select(slack, best), select(missing, best)
    return slack, xp.sign(missing) * _positive(-slack) * (slack > -math.pi)


def hand_over_value(layers: Layers, shape: GraphShape, graph: HandoverGraphs, embedding: Array, arm: Array, angle: Array) -> Array:
    """Twin values (2, ...) of handing the object to rows of arms (...) such that they carry it at angles (...)."""
    xp = namespace(angle)
    turn = _harmonics(angle)
    told = xp.concat([_turned_back(embedding[arm], turn), arm_features(graph, arm, angle, shape.slack), turn], -1)
    values = []
    for twin in range(2):
        hidden = _positive(_normalised(layers[f"value_{twin}"](told)))
        values.append(layers[f"value_{twin}_out"](_positive(layers[f"value_{twin}_hidden"](hidden)))[..., 0])
    return xp.stack(values)


def finish_value(layers: Layers, features: Array) -> Array:
    """Value (...) of finishing with arms of which :func:`arm_features` says ``features`` (..., :data:`ARM_FEATURES`)."""
    xp = namespace(features)
    steep = _clipped(FINISH_SLOPE / MARGIN_SLOPE * features[..., 1:2], -1, 1)
    hidden = _positive(layers["finish"](xp.concat([features, steep], -1)))
    value: Array = layers["finish_out"](_positive(layers["finish_hidden"](hidden)))[..., 0]
    return value


def best_places(layers: Layers, shape: GraphShape, graph: HandoverGraphs, embedding: Array, features: Array) -> tuple[Array, Array]:
    """Where in each interval the giver hands over: mean and log standard deviation (E, components) of the place before the tanh that
    brings it into (-1, 1), the interval's ends. ``features`` (A, :data:`ARM_FEATURES`) are those of the arms at their angles.

    The first component starts from the place nearest to where the receiver can finish, the second from the nearest to where it can hand
    over to an arm that can; what is learned is the difference.
    """
    xp, half, angle = namespace(features), graph.half, graph.angle[graph.giver]
    there = angle + graph.middle
    turn = _harmonics(there)
    reach, missing = graph.reaches_goal[graph.receiver], wrap(graph.goal_angle[graph.receiver] - there)
    slack, change = onward(graph, graph.receiver, there) if shape.slack else (0 * there - math.pi, 0 * there)
    width = half + 0.05
    own = [half, reach * _clipped(missing / width, -2, 2), _clipped(change / width, -2, 2), (slack > -math.pi) + 0 * half, xp.log(width)]
    parts = [
        _turned_back(embedding[graph.giver], _harmonics(angle)),
        _turned_back(embedding[graph.receiver], turn),
        features[graph.giver],
        arm_features(graph, graph.receiver, there, shape.slack),
        turn,
        xp.stack(own, -1),
    ]
    hidden = _positive(layers["place_hidden"](_positive(layers["place"](xp.concat(parts, -1)))))
    out = layers["place_out"](hidden)
    some = _positive(half - TINY) + TINY
    starts = [_before_tanh(reach * missing / some), *([_before_tanh(change / some)] if shape.slack else [])]
    starts = starts[: shape.components] + [0 * half] * (shape.components - len(starts))
    return out[:, : shape.components] + xp.stack(starts, -1), _clipped(out[:, shape.components :], *LOG_STD_RANGE)


def arrival(graph: HandoverGraphs, angle: Array, place: Array, edge: Array) -> Array:
    """Angles (m, k) at which receivers carry what givers at ``angle`` (m,) hand over at ``place`` (m, k) in rows ``edge`` of intervals."""
    return wrap((angle + graph.middle[edge])[:, None] + graph.half[edge, None] * place)


class Choice(NamedTuple):
    """Decisions (...): ``final`` or not, the ``arm``; of a hand-over the ``edge``, a row of the graph's intervals, and the ``place`` in it.

    ``value``: what the decision is worth, minus infinity where no arm can do anything.
    """

    final: Array
    arm: Array
    edge: Array
    place: Array
    value: Array


def branches(layers: Layers, shape: GraphShape, graph: HandoverGraphs) -> tuple[Array, Array, Array]:
    """All that the deterministic policy chooses between: values and places of hand-overs (E, 2 * components), values of finishing (A,).

    A problem and its mirror image are looked at alike: places are those that the actor says of either, values the mean of both.
    """
    xp, both, edges = namespace(graph.angle), graph.with_mirror(), len(graph.giver)
    embedding = embedded(layers, shape, both)
    features = arm_features(both, slice(None), both.angle, shape.slack)
    said = xp.tanh(best_places(layers, shape, both, embedding, features)[0])
    place = xp.concat([said[:edges], -said[edges:]], -1)
    tried = xp.concat([place, -place])
    there = arrival(both, both.angle[both.giver], tried, slice(None))
    receiver = both.receiver[:, None] + xp.zeros_like(tried, dtype=xp.int64)
    value = xp.amin(hand_over_value(layers, shape, both, embedding, receiver, there), 0)
    finish = finish_value(layers, features)
    return (value[:edges] + value[edges:]) / 2, place, (finish[: len(graph.arm)] + finish[len(graph.arm) :]) / 2


def chosen(graph: HandoverGraphs, value: Array, place: Array, finish: Array, most: int | None = None) -> Choice:
    """The best branch of each problem (n,), or the ``most`` best ones (n, most), the best first.

    An arm moves that reaches the object and did not move it last; one that did moves it again only where no other can.

    Args:
        graph: of the problems.
        value: (E, m) of hand-overs; a minus infinite one is never chosen while there is another.
        place: (E, m) of hand-overs, in (-1, 1).
        finish: (A,) values of finishing.
        most: how many.
    """
    xp, (n, m) = namespace(value), (graph.count, value.shape[-1])
    lowest = 0 * value[:0].sum() - math.inf
    options = xp.concat([value, lowest + xp.zeros((1, m), dtype=value.dtype, **_on(value))])[graph.outgoing].reshape(len(graph.arm), -1)
    options = xp.concat([options, finish[:, None]], -1)
    able = graph.reaches_object
    others = xp.zeros((n, graph.num_arms), dtype=xp.bool, **_on(able))
    others[graph.problem, graph.arm] = able & ~graph.was_previous
    able = able & ~(graph.was_previous & others.any(-1)[graph.problem])
    width = options.shape[-1]
    table = xp.zeros((n, graph.num_arms, width), dtype=value.dtype, **_on(value)) + lowest
    table[graph.problem, graph.arm] = xp.where(able[:, None], options, lowest)
    row = xp.full((n, graph.num_arms), -1, dtype=xp.int64, **_on(value))
    row[graph.problem, graph.arm] = xp.arange(len(graph.arm), **_on(value))
    flat = table.reshape(n, -1)
    best = xp.argmax(flat, -1)[:, None] if most is None else xp.argsort(-flat, stable=True)[:, :most]
    arm, option = best // width, best % width
    final = option == width - 1
    edges = (
        xp.concat([graph.outgoing, -1 - 0 * graph.outgoing[:, :1]], -1)
        if graph.outgoing.shape[1]
        else -1 + 0 * row[graph.problem, graph.arm][:, None]
    )
    edge = edges[row[xp.arange(n, **_on(value))[:, None], arm], xp.where(final, 0, option // m)]
    at = place[edge, option % m] if len(place) else 0.0 * best
    choice = final, arm, edge, at, taken(flat, best)
    return Choice(*(each[:, 0] for each in choice)) if most is None else Choice(*choice)


def _before_tanh(place: Array) -> Array:
    xp = namespace(place)
    return xp.arctanh(_clipped(place, -0.995, 0.995))


def _harmonics(angle: Array, count: int = HARMONICS) -> Array:
    xp = namespace(angle)
    multiples = xp.stack([(number + 1) * angle for number in range(count)], -1)
    return xp.concat([xp.cos(multiples), xp.sin(multiples)], -1)


def _turned_back(embedding: Array, turn: Array) -> Array:
    """An embedding (..., width), turned back by angles with harmonics ``turn`` (..., 2 * :data:`HARMONICS`).

    Its first half stays, the rest are pairs that turn by multiples of the angle.
    """
    xp, kept = namespace(embedding), embedding.shape[-1] // 2
    pairs = embedding[..., kept:].reshape(*embedding.shape[:-1], 2, -1, HARMONICS)
    cos, sin = turn[..., None, :HARMONICS], turn[..., None, HARMONICS:]
    first, second = pairs[..., 0, :, :], pairs[..., 1, :, :]
    shape = (*embedding.shape[:-1], -1)
    return xp.concat([embedding[..., :kept], (first * cos + second * sin).reshape(shape), (second * cos - first * sin).reshape(shape)], -1)


def _normalised(x: Array) -> Array:
    """Layer norm without weights."""
    xp = namespace(x)
    if xp is not np:
        return xp.nn.functional.layer_norm(x, (x.shape[-1],))
    count = np.float32(x.shape[-1])
    x = x - np.add.reduce(x, -1, keepdims=True) / count
    return x / np.sqrt(np.add.reduce(x * x, -1, keepdims=True) / count + np.float32(1e-5))


def _clipped(x: Array, low: float, high: float) -> Array:
    return np.minimum(np.maximum(x, low), high) if namespace(x) is np else x.clip(low, high)  # numpy's own clip is slow


def _positive(x: Array) -> Array:
    return np.maximum(x, 0) if namespace(x) is np else x.relu()


def _nonzero(x: Array) -> Any:
    return x.nonzero() if isinstance(x, np.ndarray) else x.nonzero(as_tuple=True)


def _on(like: Array) -> dict[str, Any]:
    """Where new torch tensors go; nothing for numpy."""
    return {} if isinstance(like, np.ndarray) else {"device": like.device}
