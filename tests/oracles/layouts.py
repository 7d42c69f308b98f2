"""Arms and discs on a table, from the definitions alone: who reaches what, the edges of what two arms share, random layouts.

Plain numpy that shares no code with the package; places are (..., 2) in mm, angles in rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

HALF_DIAGONAL_MM = 20 * math.sqrt(2)
"""Of the shipped block, 40 mm wide: its centre keeps so far away from a disc."""

NARROW_MM = 1e-3
"""A space in which no curve of equal angle is longer is none: arms tell places apart to 1 um."""

SURE = 1.1
"""A space counts surely if one of its curves is so many times as long."""

FLAT_RAD = 1e-7
"""A curve of equal angle nearer to 0 or pi is looked at so far from it, where it is a circle still."""


def wrapped(angle):
    """An angle in (-pi, pi]."""
    return -np.remainder(math.pi - np.asarray(angle, float), 2 * math.pi) + math.pi


@dataclass(frozen=True)
class Layout:
    """Arms and discs as a line of a problems file has them under ``arms`` and ``obstacles``."""

    arms: list[dict]
    obstacles: list[dict]

    @property
    def count(self) -> int:
        return len(self.arms)

    @cached_property
    def bases(self):
        return np.array([(arm["x_mm"], arm["y_mm"]) for arm in self.arms], float)

    @cached_property
    def facing(self):
        return np.array([arm["facing_rad"] for arm in self.arms], float)

    @cached_property
    def rings(self):
        return np.array([(arm["r_min_mm"], arm["r_max_mm"]) for arm in self.arms], float)

    @cached_property
    def yaws(self):
        return np.array([arm["yaw_range_rad"] for arm in self.arms], float)

    @cached_property
    def discs(self):
        """Rows of x, y and how near a block's centre may come."""
        rows = [(disc["x_mm"], disc["y_mm"], disc["radius_mm"] + HALF_DIAGONAL_MM) for disc in self.obstacles]
        return np.array(rows, float).reshape(-1, 3)

    def psi(self, place):
        """World yaw (..., N) of every gripper at a place: the direction from the base to it."""
        away = np.asarray(place, float)[..., None, :2] - self.bases
        return np.arctan2(away[..., 1], away[..., 0])

    def margin(self, place, arms=None):
        """How far inside what each arm (all, or those named) may use a place lies, in mm (..., N); negative outside."""
        chosen = np.arange(self.count) if arms is None else np.asarray(arms)
        place = np.asarray(place, float)[..., :2]
        away = place[..., None, :] - self.bases[chosen]
        radius = np.hypot(away[..., 0], away[..., 1])
        low, high = self.rings[chosen].T
        inside = np.minimum(radius - low, high - radius)
        yaw = wrapped(np.arctan2(away[..., 1], away[..., 0]) - self.facing[chosen])
        least, most = self.yaws[chosen].T
        within = (yaw >= least) & (yaw <= most)
        nearest = np.minimum(np.abs(wrapped(yaw - least)), np.abs(wrapped(yaw - most)))
        sideways = np.where(within, nearest, -nearest) * radius
        sideways = np.where(most - least >= 2 * math.pi - 1e-12, np.inf, sideways)
        inside = np.minimum(inside, sideways)
        for x, y, radius_mm in self.discs:
            inside = np.minimum(inside, (np.hypot(place[..., 0] - x, place[..., 1] - y) - radius_mm)[..., None])
        return inside

    def reaches(self, place, slack_mm=0.0):
        """Which arms reach a place (..., N)."""
        return self.margin(place) >= -slack_mm

    def hand_over_angle(self, place, i, j):
        """psi_i - psi_j in [0, 2 pi)."""
        away = np.asarray(place, float)[..., None, :2] - self.bases[[i, j]]
        psi = np.arctan2(away[..., 1], away[..., 0])
        return np.remainder(psi[..., 0] - psi[..., 1], 2 * math.pi)

    def circles(self, i, j):
        """Circles (x, y, radius) that may bound what arms i and j share."""
        rows = [(*self.bases[k], radius) for k in (i, j) for radius in self.rings[k]]
        return np.array([*rows, *self.discs])

    def rays(self, i, j):
        """Segments (x, y, direction, least and greatest distance) that may bound it: yaw limits."""
        rows = []
        for k in (i, j):
            if self.yaws[k, 1] - self.yaws[k, 0] < 2 * math.pi - 1e-12:
                rows += [(*self.bases[k], self.facing[k] + yaw, *self.rings[k]) for yaw in self.yaws[k]]
        return np.array(rows).reshape(-1, 5)

    def corners(self, i, j):
        """Places where two such curves meet, (n, 2), wherever they are."""
        circles, rays = self.circles(i, j), self.rays(i, j)
        found = [place for one, other in combinations(circles, 2) for place in circles_meet(one, other)]
        found += [place for ray in rays for circle in circles for place in ray_meets(ray, circle)]
        for (x, y, one, *_), (u, v, other, *_) in combinations(rays, 2):
            cross = math.sin(other - one)
            if abs(cross) > 1e-12:
                t = ((u - x) * math.sin(other) - (v - y) * math.cos(other)) / cross
                found.append((x + t * math.cos(one), y + t * math.sin(one)))
        return np.array(found).reshape(-1, 2)

    def edge_curves(self, i, j):
        """Functions from t in [0, 1] to places (n, 2), one for every curve that may bound what arms i and j share."""
        curves = []
        for x, y, radius in self.circles(i, j):
            curves.append(lambda t, x=x, y=y, r=radius: np.stack([x + r * np.cos(2 * np.pi * t), y + r * np.sin(2 * np.pi * t)], -1))
        for x, y, a, low, high in self.rays(i, j):
            curves.append(
                lambda t, x=x, y=y, a=a, low=low, high=high: np.stack(
                    [x + (low + t * (high - low)) * math.cos(a), y + (low + t * (high - low)) * math.sin(a)], -1
                )
            )
        return curves

    def sampled_angles(self, i, j, step_rad, slack_mm=1e-9, points=800):
        """Hand-over angles of places on the edge of what arms i and j share, no further apart than ``step_rad`` along it; maybe none.

        A curve of equal angle ends at the bases, which neither arm reaches: so every angle that is offered is offered on the edge.
        """
        reach = self.rings[i, 1] + self.rings[j, 1]
        if math.dist(self.bases[i], self.bases[j]) > reach + 1:
            return np.zeros(0)
        angles = [self._angles_of(self.corners(i, j), i, j, slack_mm)]
        for curve in self.edge_curves(i, j):
            t = np.linspace(0, 1, points)
            place = curve(t)
            near = self.margin(place, (i, j)).min(-1) > -2 * np.hypot(*np.diff(place[:2], axis=0)[0])
            near = np.flatnonzero(near[:-1] | near[1:])
            steps = np.abs(wrapped(self.hand_over_angle(place[near + 1], i, j) - self.hand_over_angle(place[near], i, j)))
            extra = np.ceil(steps / step_rad).astype(int) + 1
            start = np.repeat(t[near], extra)
            rank = np.arange(extra.sum()) - np.repeat(np.cumsum(extra) - extra, extra)
            finer = start + rank / np.repeat(extra, extra) * (t[1] - t[0])
            angles.append(self._angles_of(curve(finer), i, j, slack_mm))
        return np.sort(np.concatenate(angles))

    def curve_mm(self, i, j, angle):
        """How long the curve of an equal hand-over angle is, without what either arm may not use: an arc of a circle through both bases."""
        (ax, ay), (bx, by) = self.bases[[i, j]]
        sine = math.copysign(max(abs(math.sin(angle)), FLAT_RAD), math.sin(angle))
        radius = math.hypot(bx - ax, by - ay) / (2 * abs(sine))
        up = math.cos(angle) / (2 * sine)
        circle = ((ax + bx) / 2 + up * (by - ay), (ay + by) / 2 - up * (bx - ax), radius)
        ends = [(ax, ay), (bx, by)]
        ends += [place for other in self.circles(i, j) for place in circles_meet(other, circle)]
        ends += [place for ray in self.rays(i, j) for place in ray_meets(ray, circle)]
        turns = np.sort(np.arctan2(*(np.array(ends) - circle[:2]).T[::-1]))
        width = np.diff(turns, append=turns[0] + 2 * math.pi)
        middle = turns + width / 2
        place = circle[:2] + radius * np.stack([np.cos(middle), np.sin(middle)], -1)
        # The other arc of the circle has the angle on the other side of pi.
        usable = (np.abs(wrapped(self.hand_over_angle(place, i, j) - angle)) < 1e-3) & (self.margin(place, (i, j)).min(-1) >= 0)
        return float(radius * width[usable].sum())

    def counts(self, i, j, angles, step_rad):
        """Which of the sorted ``angles`` (n,), sampled ``step_rad`` apart, are surely of a space that is not narrow all over: bool (n,)."""
        counted = np.zeros(len(angles), bool)
        for group in np.split(np.arange(len(angles)), np.flatnonzero(np.diff(angles) > 2 * step_rad) + 1):
            tried = sorted(set(np.linspace(0, len(group) - 1, 41).astype(int)), key=lambda index: abs(2 * index - len(group)))
            counted[group] = any(self.curve_mm(i, j, angles[group[index]]) > SURE * NARROW_MM for index in tried if len(group))
        return counted

    def _angles_of(self, place, i, j, slack_mm):
        good = self.margin(place, (i, j)).min(-1) >= -slack_mm
        return self.hand_over_angle(place[good], i, j)

    def sample_reached(self, arm, count, draw):
        """Places (n, 2), n <= count, uniform on what an arm reaches."""
        low, high = self.rings[arm]
        radius = np.sqrt(draw.uniform(low * low, high * high, count))
        angle = self.facing[arm] + draw.uniform(*self.yaws[arm], count)
        place = self.bases[arm] + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return place[self.margin(place, [arm])[:, 0] >= 0]

    def sample_shared(self, i, j, count, draw):
        """Places (n, 2), n <= count, uniform on what both reach."""
        place = self.sample_reached(i, count, draw)
        return place[self.margin(place, [j])[:, 0] >= 0]

    def is_connected(self, draw, least=20, count=4000):
        """Whether the arms are connected by shared spaces in which at least ``least`` of ``count`` random places lie."""
        group = np.arange(self.count)
        for i, j in combinations(range(self.count), 2):
            if group[i] != group[j] and len(self.sample_shared(i, j, count, draw)) >= least:
                group[group == group[j]] = group[i]
        return len(set(group)) == 1

    def sample_problems(self, count, draw):
        """Starts and goals, each (count, 3), uniform on where an arm may take and leave a block, and turned anyhow."""
        shares = np.diff(self.rings**2)[:, 0] * np.diff(self.yaws)[:, 0]
        places = np.zeros((0, 2))
        while len(places) < 2 * count:
            chosen = np.bincount(draw.choice(self.count, 6 * count + 60, p=shares / shares.sum()), minlength=self.count)
            more = np.concatenate([self.sample_reached(arm, number, draw) for arm, number in enumerate(chosen)])
            more = more[draw.uniform(0, 1, len(more)) * self.reaches(more).sum(-1) < 1]  # what several arms reach is drawn more often
            places = np.concatenate([places, draw.permutation(more)])
        pose = np.concatenate([places[: 2 * count], draw.uniform(-math.pi, math.pi, (2 * count, 1))], -1)
        return pose[:count], pose[count:]


def circles_meet(one, other):
    """Places where two circles (x, y, radius) meet."""
    (x, y, r), (u, v, s) = one, other
    distance = math.hypot(u - x, v - y)
    if distance == 0 or not abs(r - s) <= distance <= r + s:
        return []
    along = (r * r - s * s + distance * distance) / (2 * distance)
    across = math.sqrt(max(r * r - along * along, 0.0))
    ex, ey = (u - x) / distance, (v - y) / distance
    return [(x + along * ex - side * across * ey, y + along * ey + side * across * ex) for side in (-1, 1)]


def ray_meets(ray, circle):
    """Places where the line of a ray (x, y, direction, ...) meets a circle (x, y, radius)."""
    (x, y, direction, *_), (u, v, s) = ray, circle
    dx, dy = math.cos(direction), math.sin(direction)
    along, across = dx * (u - x) + dy * (v - y), dx * (v - y) - dy * (u - x)
    if abs(across) > s:
        return []
    half = math.sqrt(s * s - across * across)
    return [(x + t * dx, y + t * dy) for t in (along - half, along + half)]


def random_arm(draw, name, ring=None):
    """An arm at the origin, facing anywhere; the yaw range symmetric, not symmetric, or the whole turn."""
    low, high = ring or (draw.uniform(100, 160), draw.uniform(200, 270))
    kind = draw.integers(4)
    if kind == 0:
        yaw = (-math.pi, math.pi)
    elif kind == 1:
        yaw = (-(half := math.radians(draw.uniform(60, 180))), half)
    else:
        yaw = (-math.radians(draw.uniform(60, 180)), math.radians(draw.uniform(60, 180)))
    return {
        "name": name,
        "x_mm": 0.0,
        "y_mm": 0.0,
        "facing_rad": draw.uniform(-math.pi, math.pi),
        "r_min_mm": low,
        "r_max_mm": high,
        "yaw_range_rad": list(yaw),
    }


def random_layout(draw, count, *, mixed=True, close=False, discs=0):
    """A connected layout of ``count`` arms.

    ``mixed``: a ring each, else one for all; ``close``: two bases at least stand inside each other's ring, at 60 to 180 mm; ``discs``: how
    many keep-out places, the first of them in the middle of a curve of equal hand-over angle.
    """
    while True:
        ring = None if mixed else (draw.uniform(100, 160), draw.uniform(200, 270))
        arms = [random_arm(draw, f"arm {k}" if k % 2 else f"{chr(97 + k)}-{k}", ring) for k in range(count)]
        arms[0]["x_mm"], arms[0]["y_mm"] = draw.uniform(-500, 500, 2)
        for k in range(1, count):
            _stand_beside(draw, arms[:k], arms[k], (60, 180) if close and k == 1 else (60, 440))
        bare = Layout(arms, [])
        if not bare.is_connected(draw):
            continue
        obstacles = []
        for index in range(discs):
            disc = _disc_in_mid_curve(draw, bare) if index == 0 else _disc_anywhere(draw, bare)
            obstacles += [disc] if disc else []
        layout = Layout(arms, obstacles)
        if len(obstacles) == discs and (not discs or layout.is_connected(draw)):
            return layout


def _stand_beside(draw, others, arm, distance):
    while True:
        beside = others[draw.integers(len(others))]
        away, direction = draw.uniform(*distance), draw.uniform(-math.pi, math.pi)
        arm["x_mm"] = beside["x_mm"] + away * math.cos(direction)
        arm["y_mm"] = beside["y_mm"] + away * math.sin(direction)
        if min(math.hypot(arm["x_mm"] - each["x_mm"], arm["y_mm"] - each["y_mm"]) for each in others) >= 60:
            arm["facing_rad"] = float(wrapped(direction + math.pi + draw.normal(0, 0.9)))
            return


def _shared_places(draw, layout):
    """Two arms and places that both reach; of a connected layout, in which only a small space is missed now and then."""
    pairs = list(combinations(range(layout.count), 2))
    while True:
        for index in draw.permutation(len(pairs)):
            place = layout.sample_shared(*pairs[index], 2000, draw)
            if len(place) >= 10:
                return pairs[index], place


def _disc_anywhere(draw, layout):
    _, place = _shared_places(draw, layout)
    x, y = place[0] + draw.normal(0, 60, 2)
    return _disc(x, y, draw.uniform(3, 40))


def _disc(x, y, radius):
    return {"x_mm": float(x), "y_mm": float(y), "radius_mm": float(radius), "height_mm": 60.0}


def equal_angle_curve(layout, i, j, place, points=4000):
    """Places (n, 2) of the circle through both bases and ``place``, and whether both arms may use them (n,)."""
    (ax, ay), (bx, by), (cx, cy) = layout.bases[i], layout.bases[j], place
    matrix = 2 * np.array([(bx - ax, by - ay), (cx - ax, cy - ay)])
    centre = np.linalg.solve(matrix, [bx**2 + by**2 - ax**2 - ay**2, cx**2 + cy**2 - ax**2 - ay**2])
    angle = np.linspace(0, 2 * math.pi, points, endpoint=False)
    curve = centre + math.dist(centre, place) * np.stack([np.cos(angle), np.sin(angle)], -1)
    same = np.abs(wrapped(layout.hand_over_angle(curve, i, j) - layout.hand_over_angle(place, i, j))) < 1e-6
    return curve, same & (layout.margin(curve, (i, j)).min(-1) >= 0)


def _disc_in_mid_curve(draw, layout):
    """A disc that leaves places on either side of it on one curve of equal hand-over angle; None if eight curves are all too short."""
    (i, j), places = _shared_places(draw, layout)
    for place in places[:8]:
        curve, usable = equal_angle_curve(layout, i, j, place)
        if usable.all() or not usable.any():
            continue
        first = int(np.flatnonzero(usable & ~np.roll(usable, 1))[0])
        usable, curve = np.roll(usable, -first), np.roll(curve, -first, 0)
        length = int(np.argmin(usable))  # of the first run
        chord = math.dist(curve[0], curve[length - 1])
        if chord > 2 * HALF_DIAGONAL_MM + 20:
            x, y = curve[length // 2]
            return _disc(x, y, draw.uniform(2, chord / 2 - HALF_DIAGONAL_MM - 5))
    return None


def layout_with_a_sliver(less_mm=0.0):
    """Three arms and four discs: arms 0 and 2 share, beside a large space, a triangle with sides of 60 to 101 nm between both rings and a
    yaw limit. It grows as the least radius of the rings gets less.
    """
    low, high = 118.13767059683671 - less_mm, 217.79420120278942
    placed = [
        ("a-0", 470.777635359903, 325.26768757609466, 0.7277683430718525, math.pi),
        ("arm 1", 393.37480456128355, 332.0054156637743, -0.15964859027898548, 2.5681689335927045),
        ("c-2", 259.7358734081069, 332.2137624127693, -0.8096165083891043, 1.242017139014224),
    ]
    discs = [
        (326.26743321845817, 148.2252672419632, 14.212144365037801),
        (294.5040542421485, 61.48929117095875, 12.882522449395086),
        (446.6484730280467, 173.6903958718725, 30.729324844980734),
        (586.2307151888295, 379.34540839515785, 22.355705995258223),
    ]
    ring = {"r_min_mm": low, "r_max_mm": high}
    arms = [
        {"name": name, "x_mm": x, "y_mm": y, "facing_rad": facing, "yaw_range_rad": [-half, half]} | ring
        for name, x, y, facing, half in placed
    ]
    return Layout(arms, [_disc(*disc) for disc in discs])
