"""Straight walking: footsteps, ZMP and swing feet, with the timing of the paper (Sec. 7.1, Fig. 5) as default."""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import PPoly

from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.walking.lipm import LipmTrajectory, solve_lipm
from fbse_drake.walking.plan import Phase, PointMotion, TaskPlan, check_zmp, smooth_step

# Coefficients, highest power first, of the quintic step 0 -> 1 and of the bump 64 s^3 (1 - s)^3, in local time s in [0, 1].
_STEP = np.array([0.0, 6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
_BUMP = np.array([-64.0, 192.0, -192.0, 64.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Walk:
    """Walks straight ahead from rest to rest: the first and the last step bring the feet side by side."""

    # Advance of the stance position from one step to the next [m]; a swing foot travels twice that.
    step_length: float = 0.10
    # Lift of the swing foot [m].
    step_height: float = 0.04
    # Number of single supports, and the side that supports first.
    single_supports: int = 7
    first_support: str = "left"
    # Duration [s] of the first double support, of each single support, and of each double support in between; the walk ends
    # with a double support of the same length, after which the robot stands.
    initial_double_support: float = 0.5
    single_support: float = 0.6
    double_support: float = 0.9
    # Height of the centre of mass above the ground [m], constant.
    com_height: float = 0.66
    # Distance between the soles' centres [m].
    foot_spacing: float = 0.20
    # Where the ZMP stands in the supporting foot [m]: ahead of the sole frame, and inwards from it (more means less sway).
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
        require_not_negative(self, "step_height")

    def phases(self, sides: tuple[str, str], duration: float) -> list[Phase]:
        """Double and single supports in turn, up to the end of the last double support or `duration`, whichever is later.

        Raises:
            InputError: `first_support` is no side of this robot.
        """
        if self.first_support not in sides:
            raise InputError(
                f"first_support: expected one of {', '.join(sides)}, found {self.first_support}"
            )
        other = next(side for side in sides if side != self.first_support)
        support = [self.first_support if k % 2 == 0 else other for k in range(self.single_supports)]
        # Rounded to a nanosecond, so that a phase ends on a control tick where it should.
        phases = [Phase(0.0, round(self.initial_double_support, 9), sides)]
        for side in support:
            phases.append(
                Phase(phases[-1].end, round(phases[-1].end + self.single_support, 9), (side,))
            )
            phases.append(
                Phase(phases[-1].end, round(phases[-1].end + self.double_support, 9), sides)
            )
        last = phases[-1]
        return [*phases[:-1], Phase(last.start, max(last.end, duration), sides)]

    def footholds(self, phases: list[Phase]) -> dict[int, tuple[str, float, float]]:
        """For each single support, by phase number: swing side, and where its sole leaves and lands in x [m]."""
        singles = [(number, phase) for number, phase in enumerate(phases) if phase.is_single]
        sides = phases[0].support
        x = dict.fromkeys(sides, self.start)
        result = {}
        for k, (number, phase) in enumerate(singles):
            stance = phase.support[0]
            swing = next(side for side in sides if side != stance)
            landing = x[stance] + (
                0.0 if k == len(singles) - 1 and len(singles) > 1 else self.step_length
            )
            result[number] = (swing, x[swing], landing)
            x[swing] = landing
        return result

    def plan(
        self,
        time: np.ndarray,
        lateral: dict[str, float],
        foot_corners: dict[str, np.ndarray],
        gravity: float,
    ) -> TaskPlan:
        """CoM, feet and ZMP at `time` (N,) [s].

        Args:
            lateral: direction of each side in y, +1 or -1; its order is that of the sides.
            foot_corners: places of the pads in each sole frame, (pads, 3) [m].
            gravity: g [m/s^2].

        Raises:
            InputError: the ZMP leaves the support polygon less its margin, or a value is impossible.
        """
        phases = self.phases(tuple(lateral), float(time[-1]))
        footholds = self.footholds(phases)
        feet = {side: self._foot(side, lateral[side], time, phases, footholds) for side in lateral}
        rest_point = {
            side: np.array([self.zmp_forward, -sign * self.zmp_inward])
            for side, sign in lateral.items()
        }
        zmp, com = self._com(phases, footholds, lateral, rest_point, gravity)
        height = [np.full((len(time), 1), value) for value in (self.com_height, 0.0, 0.0)]
        com_motion = PointMotion(*(np.hstack([com(time, k), height[k]]) for k in range(3)))
        plan = TaskPlan(
            time, com_motion, feet, zmp(np.clip(time, 0, zmp.x[-1])), tuple(phases), rest_point
        )
        check_zmp(plan, foot_corners, self.zmp_margin)
        return plan

    def _foot(
        self,
        side: str,
        lateral: float,
        time: np.ndarray,
        phases: list[Phase],
        footholds: dict[int, tuple[str, float, float]],
    ) -> PointMotion:
        position = np.tile([self.start, lateral * self.foot_spacing / 2, 0.0], (len(time), 1))
        velocity, acceleration = np.zeros_like(position), np.zeros_like(position)
        for number, (swing, leave, land) in footholds.items():
            if swing != side:
                continue
            length = phases[number].end - phases[number].start
            s = (time - phases[number].start) / length
            position[s >= 1, 0] = land
            inside = (0 < s) & (s < 1)
            s = s[inside]
            for order, target in enumerate((position, velocity, acceleration)):
                forward = (land - leave) * smooth_step(s, order)
                lift = self.step_height * np.polyval(np.polyder(_BUMP, order), s)
                target[inside, 0] = (forward + (leave if order == 0 else 0.0)) / length**order
                target[inside, 2] = lift / length**order
        return PointMotion(position, velocity, acceleration)

    def _com(
        self,
        phases: list[Phase],
        footholds: dict[int, tuple[str, float, float]],
        lateral: dict[str, float],
        rest_point: dict[str, np.ndarray],
        gravity: float,
    ) -> tuple[PPoly, LipmTrajectory]:
        """ZMP (x, y) and the CoM that goes with it, at rest at both ends.

        In a single support the ZMP rests in the supporting foot, in double support it moves smoothly from foot to foot. The first
        and last double support hold a bump that first sends the ZMP the other way, as people do who start to walk.
        """
        middle = np.array([self.start + self.zmp_forward, 0.0])
        x = dict.fromkeys(lateral, self.start)
        targets = [middle]
        for number, phase in enumerate(phases):
            if phase.is_single:
                side = phase.support[0]
                targets.append(
                    np.array([x[side], lateral[side] * self.foot_spacing / 2]) + rest_point[side]
                )
                x[footholds[number][0]] = footholds[number][2]
        targets.append(np.array([np.mean(list(x.values())) + self.zmp_forward, 0.0]))

        # Double supports move, single supports rest, and after the last double support the robot stands.
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
        breaks = np.array(breaks)

        def polynomial(step: np.ndarray, offset: np.ndarray, bumps: np.ndarray) -> PPoly:
            c = _STEP[:, None, None] * step + _BUMP[:, None, None] * bumps[:, None]
            c[-1] += offset
            return PPoly(
                c / np.diff(breaks)[None, :, None] ** np.arange(6, -1, -1)[:, None, None], breaks
            )

        step, offset = np.array([m[1] for m in moves]), np.array([m[0] for m in moves])
        plain = polynomial(step, offset, np.zeros(len(moves)))
        pieces = np.arange(len(moves))
        first, last = (
            polynomial(0 * step, 0 * offset, pieces == bumped) for bumped in (0, len(phases) - 1)
        )
        ends = breaks[[0, -1]]
        # The CoM depends linearly on the ZMP: two bumps make its velocity vanish at both ends.
        speed = [solve_lipm(zmp, self.com_height, gravity)(ends, 1) for zmp in (plain, first, last)]
        amplitude = np.linalg.solve(np.stack([speed[1][:, 0], speed[2][:, 0]], axis=1), -speed[0])
        c = plain.c + first.c * amplitude[0] + last.c * amplitude[1]
        zmp = PPoly(c, breaks)
        return zmp, solve_lipm(zmp, self.com_height, gravity)
