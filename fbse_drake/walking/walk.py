"""Walking from rest to rest: footsteps, ZMP and swing feet, with the timing of the paper (Sec. 7.1,
Fig. 5) as default."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PPoly

from fbse_drake.errors import (
    InputError,
    require_at_most,
    require_not_negative,
    require_positive,
)
from fbse_drake.robot.plant import gravity_on_slope
from fbse_drake.walking.lipm import LipmTrajectory, solve_lipm
from fbse_drake.walking.plan import (
    Phase,
    PointMotion,
    TaskPlan,
    YawMotion,
    check_zmp,
    smooth_step,
)

# Coefficients, highest power first, of the quintic step 0 -> 1 and of the bump 64 s^3 (1 - s)^3, in
# local time s in [0, 1].
_STEP = np.array([0.0, 6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
_BUMP = np.array([-64.0, 192.0, -192.0, 64.0, 0.0, 0.0, 0.0])
# The vertical part of a place.
_UP = np.array([0.0, 0.0, 1.0, 0.0])
# The share of its time that a foot on stairs moves but up at first, and but down in the end.
_UPRIGHT = 0.2


class Place(NamedTuple):
    """A level place on the ground: its point in the world [m], and its turn to the left [rad]."""

    x: float
    y: float
    z: float
    yaw: float

    def beside(self, ahead: float, left: float, above: float = 0.0, yaw: float = 0.0) -> "Place":
        """The place that lies so in its axes."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return Place(
            self.x + (c * ahead - s * left),
            self.y + (s * ahead + c * left),
            self.z + above,
            self.yaw + yaw,
        )


class Step(NamedTuple):
    """What happens in a single support."""

    # Feet that swing.
    swing: tuple[str, ...]
    # Middle between the feet, as it is for those that swing, where they leave and where they land.
    leave: Place
    land: Place


@dataclass(frozen=True)
class Walk:
    """Walks from rest to rest: the first and the last step bring the feet side by side."""

    # Advance of the stance position from one step to the next [m]; a swing foot travels twice that.
    step_length: float = 0.10
    # The same to the left [m], as a turn to the left [rad], and upwards [m], which is how far each
    # of the ground's steps is above the one before.
    step_left: float = 0.0
    step_turn: float = 0.0
    step_rise: float = 0.0
    # The ground's slope that is known of, see `Ground.slope` [rad].
    slope: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Lift of the swing foot [m].
    step_height: float = 0.04
    # Number of single supports, and the side that supports first.
    single_supports: int = 7
    first_support: str = "left"
    # Duration [s] of the first double support, of each single support, and of each double support
    # in between; the walk ends with a double support of the same length, after which the robot
    # stands.
    initial_double_support: float = 0.5
    single_support: float = 0.6
    double_support: float = 0.9
    # Height of the centre of mass above the ground [m], constant; on a staircase above the line
    # through its steps.
    com_height: float = 0.66
    # Distance between the soles' centres [m], and that of front and rear feet, where there are
    # such.
    foot_spacing: float = 0.20
    wheelbase: float = 0.0
    # Where the ZMP stands in the supporting foot [m]: ahead of the sole frame, and inwards from it
    # (more means less sway).
    zmp_forward: float = 0.025
    zmp_inward: float = 0.01
    # Smallest distance of the planned ZMP to the edge of the support polygon [m].
    zmp_margin: float = 0.02
    # Where the sole frames stand first [m], in walking direction (Fig. 5).
    start: float = -0.025
    # Where joints that are no leg's are held, by joint [rad]; 0 by default.
    posture: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_positive(
            self,
            "initial_double_support",
            "single_support",
            "double_support",
            "com_height",
            "foot_spacing",
        )
        if self.single_supports < 1:
            raise InputError(
                f"single_supports: expected a whole number >= 1, found {self.single_supports}"
            )
        require_at_most(self, single_supports=10_000)
        require_not_negative(self, "step_height")
        if len(self.slope) != 2:
            raise InputError(f"slope: expected two numbers, found {self.slope}")
        if self.step_rise != 0 and (self.step_left or self.step_turn or self.step_length == 0):
            raise InputError(
                "step_rise: stairs are climbed straight ahead: expected a step_length, and no "
                "step_left or step_turn"
            )

    @property
    def ascent(self) -> float:
        """How much the line through the footholds rises per way ahead."""
        return self.step_rise / self.step_length if self.step_rise else 0.0

    def supports(self, stance: Mapping[str, np.ndarray]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The feet that support first, and those that support then, in turn.

        Args:
            stance: see `plan`.

        Raises:
            InputError: `first_support` is no side of this robot, or it cannot walk so.
        """
        self._check_side(stance)
        if len(stance) != 2:
            raise InputError(f"a walk takes two legs, found {', '.join(stance)}; use Trot")
        other = next(side for side in stance if side != self.first_support)
        return (self.first_support,), (other,)

    def _check_side(self, stance: Mapping[str, np.ndarray]) -> None:
        if self.first_support not in stance:
            allowed = ", ".join(stance)
            raise InputError(
                f"first_support: expected one of {allowed}, found {self.first_support}"
            )

    def phases(
        self, sides: tuple[str, ...], supports: tuple[tuple[str, ...], ...], duration: float
    ) -> list[Phase]:
        """Double and single supports in turn, up to the end of the last double support or
        `duration`, whichever is later.

        Args:
            supports: see there.
        """
        legs, support = len(sides), [supports[k % 2] for k in range(self.single_supports)]
        # Rounded to a nanosecond, so that a phase ends on a control tick where it should.
        phases = [Phase(0.0, round(self.initial_double_support, 9), sides, legs)]
        for standing in support:
            end = round(phases[-1].end + self.single_support, 9)
            phases.append(Phase(phases[-1].end, end, standing, legs))
            end = round(phases[-1].end + self.double_support, 9)
            phases.append(Phase(phases[-1].end, end, sides, legs))
        last = phases[-1]
        return [*phases[:-1], Phase(last.start, max(last.end, duration), sides, legs)]

    def steps(self, phases: list[Phase]) -> dict[int, Step]:
        """What happens in each single support, by phase number."""
        singles = [(number, phase) for number, phase in enumerate(phases) if phase.is_single]
        sides = phases[0].support
        # Of each foot, the middle between the feet as it sees it.
        middle = dict.fromkeys(sides, Place(self.start, 0.0, 0.0, 0.0))
        result = {}
        for k, (number, phase) in enumerate(singles):
            swing = tuple(side for side in sides if side not in phase.support)
            land = middle[phase.support[0]]
            if k < len(singles) - 1 or len(singles) == 1:
                land = land.beside(self.step_length, self.step_left, self.step_rise, self.step_turn)
            result[number] = Step(swing, middle[swing[0]], land)
            middle |= dict.fromkeys(swing, land)
        return result

    def plan(
        self,
        time: np.ndarray,
        stance: Mapping[str, np.ndarray],
        foot_corners: dict[str, np.ndarray],
        gravity: np.ndarray,
    ) -> TaskPlan:
        """CoM, feet and ZMP at `time` (N,) [s].

        Args:
            stance: direction of each leg from the middle of the legs, (x, y), each +1, 0 or -1.
            foot_corners: places of the pads in each sole frame, (pads, 3) [m].
            gravity: of a level world, (3,) [m/s^2].

        Raises:
            InputError: the ZMP leaves the support polygon less its margin, or a value is
                impossible.
        """
        phases = self.phases(tuple(stance), self.supports(stance), float(time[-1]))
        steps = self.steps(phases)
        reach = np.array([self.wheelbase / 2, self.foot_spacing / 2])
        beside = {side: sign * reach for side, sign in stance.items()}
        rest_point = {
            side: np.array([self.zmp_forward, -sign[1] * self.zmp_inward])
            for side, sign in stance.items()
        }
        feet = {side: self._foot(side, beside[side], time, phases, steps) for side in stance}
        tilted = gravity_on_slope(gravity, self.slope)
        zmp, com = self._com(phases, steps, beside, rest_point, -tilted[2])
        # Gravity along the ground is balanced where the CoM is so far uphill.
        uphill = self.com_height * tilted / tilted[2]
        motion = PointMotion(*(self._on_line(com(time, order), order) for order in range(3)))
        motion = replace(motion, position=motion.position + [*uphill[:2], 0.0])
        plan = TaskPlan(
            time,
            motion,
            {side: foot for side, (foot, _) in feet.items()},
            {side: yaw for side, (_, yaw) in feet.items()},
            zmp(np.clip(time, 0, zmp.x[-1])),
            tuple(phases),
            rest_point,
            tilted,
        )
        check_zmp(plan, foot_corners, self.zmp_margin)
        return plan

    def _on_line(self, com: np.ndarray, order: int) -> np.ndarray:
        """The centre of mass or its derivative (N, 3) from its course in x and y (N, 2).

        Its height above the line through the footholds is constant: so the LIPM holds on a slanted
        plane as well (Kajita et al. 2001).
        """
        ahead = com[:, :1] - (self.start + self.zmp_forward if order == 0 else 0.0)
        height = self.ascent * ahead + (self.com_height if order == 0 else 0.0)
        return np.hstack([com, height])

    def _foot(
        self,
        side: str,
        beside: np.ndarray,
        time: np.ndarray,
        phases: list[Phase],
        steps: dict[int, Step],
    ) -> tuple[PointMotion, YawMotion]:
        # Place [m, rad] and its derivatives, (N, 4) each.
        first = Place(self.start, 0.0, 0.0, 0.0).beside(*beside)
        motion = [np.tile(np.array(first), (len(time), 1))]
        motion += [np.zeros_like(motion[0]) for _ in range(2)]
        for number, step in steps.items():
            if side not in step.swing:
                continue
            leave, land = (np.array(x.beside(*beside)) for x in (step.leave, step.land))
            length = phases[number].end - phases[number].start
            s = (time - phases[number].start) / length
            motion[0][s >= 1] = land
            inside = (0 < s) & (s < 1)
            swing = self._climb if self.step_rise else self._swing
            for order, target in enumerate(motion):
                target[inside] = swing(leave, land, s[inside][:, None], order) / length**order
        place = [values[:, :3] for values in motion]
        return PointMotion(*place), YawMotion(*(values[:, 3] for values in motion))

    def _swing(self, leave: np.ndarray, land: np.ndarray, s: np.ndarray, order: int) -> np.ndarray:
        """A swing foot's place or its derivative (N, 4) at the share s (N, 1) of its time."""
        moved = (land - leave) * smooth_step(s, order)
        lift = self.step_height * np.polyval(np.polyder(_BUMP, order), s)
        return moved + ((leave if order == 0 else 0.0) + lift * _UP)

    def _climb(self, leave: np.ndarray, land: np.ndarray, s: np.ndarray, order: int) -> np.ndarray:
        """The same on stairs, whose edges are in the way: first up, then ahead, and down again."""
        apex = max(leave[2], land[2]) + self.step_height
        up, down = (2.0**order * smooth_step(2.0 * s - late, order) for late in (0.0, 1.0))
        height = (apex - leave[2]) * up + (land[2] - apex) * down
        duration = 1.0 - 2.0 * _UPRIGHT
        ahead = smooth_step((s - _UPRIGHT) / duration, order) / duration**order
        moved = (land - leave) * (1.0 - _UP) * ahead + height * _UP
        return moved + (leave if order == 0 else 0.0)

    def _com(
        self,
        phases: list[Phase],
        steps: dict[int, Step],
        beside: Mapping[str, np.ndarray],
        rest_point: dict[str, np.ndarray],
        gravity: float,
    ) -> tuple[PPoly, LipmTrajectory]:
        """ZMP (x, y) and the CoM that goes with it, at rest at both ends.

        In a single support the ZMP rests in the supporting feet, in double support it moves
        smoothly from foot to foot. The first and last double support hold a bump that first sends
        the ZMP the other way, as people do who start to walk.
        """
        middle = dict.fromkeys(beside, Place(self.start, 0.0, 0.0, 0.0))

        def rest(sides: tuple[str, ...]) -> np.ndarray:
            """The middle of where the ZMP rests in these feet."""
            places = [middle[side].beside(*(beside[side] + rest_point[side])) for side in sides]
            return np.mean([place[:2] for place in places], axis=0)

        targets = [rest(phases[0].support)]
        for number, phase in enumerate(phases):
            if phase.is_single:
                targets.append(rest(phase.support))
                middle |= dict.fromkeys(steps[number].swing, steps[number].land)
        targets.append(rest(phases[-1].support))

        # Double supports move, single supports rest, and after the last double support the robot
        # stands.
        breaks = [phase.start for phase in phases] + [
            round(phases[-1].start + self.double_support, 9)
        ]
        moves = []
        for number, phase in enumerate(phases):
            k = (number + 1) // 2
            end = targets[k] if phase.is_single else targets[k + 1]
            moves.append((targets[k], end - targets[k]))
        if phases[-1].end > breaks[-1]:
            breaks.append(phases[-1].end)
            moves.append((targets[-1], np.zeros(2)))
        ends = np.array([breaks[0], breaks[-1]])

        def polynomial(step: np.ndarray, offset: np.ndarray, bumps: np.ndarray) -> PPoly:
            c = _STEP[:, None, None] * step + _BUMP[:, None, None] * bumps[:, None]
            c[-1] += offset
            return PPoly(
                c / np.diff(breaks)[:, None] ** np.arange(6, -1, -1)[:, None, None], breaks
            )

        step, offset = np.array([m[1] for m in moves]), np.array([m[0] for m in moves])
        plain = polynomial(step, offset, np.zeros(len(moves)))
        pieces = np.arange(len(moves))
        first, last = (
            polynomial(0 * step, 0 * offset, pieces == bumped) for bumped in (0, len(phases) - 1)
        )
        # The CoM depends linearly on the ZMP: two bumps make its velocity vanish at both ends.
        speed = [solve_lipm(zmp, self.com_height, gravity)(ends, 1) for zmp in (plain, first, last)]
        amplitude = np.linalg.solve(np.stack([speed[1][:, 0], speed[2][:, 0]], axis=1), -speed[0])
        c = plain.c + first.c * amplitude[0] + last.c * amplitude[1]
        zmp = PPoly(c, breaks)
        return zmp, solve_lipm(zmp, self.com_height, gravity)


@dataclass(frozen=True)
class Trot(Walk):
    """Walks on four legs from rest to rest: two that are diagonally opposite step together. Six
    legs step as two tripods.

    A single support is one by half of the legs, between which the ZMP rests, and in a double
    support all stand. Two point feet do not keep the robot from tipping over the line between them:
    steps are short, and all legs stand often.
    """

    step_length: float = 0.03
    step_height: float = 0.03
    single_supports: int = 24
    # One of the legs that support first.
    first_support: str = "front_left"
    initial_double_support: float = 0.6
    single_support: float = 0.2
    double_support: float = 0.2
    com_height: float = 0.38
    foot_spacing: float = 0.34
    wheelbase: float = 0.5
    zmp_forward: float = 0.0
    zmp_inward: float = 0.0
    start: float = 0.0

    def supports(self, stance: Mapping[str, np.ndarray]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        self._check_side(stance)
        rows = sorted({ahead for ahead, _ in stance.values()})
        places = {(ahead, left) for ahead, left in stance.values() if left != 0}
        if len(rows) < 2 or len(places) != len(stance) or len(stance) != 2 * len(rows):
            raise InputError("a trot takes pairs of legs, one behind the other; use Walk")
        # A leg steps with neither the one across nor the one behind.
        hands = {
            side: (rows.index(ahead) + (left > 0)) % 2 for side, (ahead, left) in stance.items()
        }
        first = tuple(side for side in stance if hands[side] == hands[self.first_support])
        return first, tuple(side for side in stance if side not in first)
