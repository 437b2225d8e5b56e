"""The dictionary of a log: every effect that could explain its residual, as columns that know
nothing of noise."""

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Literal

import numpy as np

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.significance import Significance
from fbse_drake.discrepancy.identification.inertial import (
    UntrustedInertia,
    untrusted_bodies,
    untrusted_inertia,
)
from fbse_drake.discrepancy.identification.regression import Signature, WhitenedResidual
from fbse_drake.discrepancy.residual.evidence import travel_of
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.white_noise import step_of
from fbse_drake.effects.contact import ContactEffect
from fbse_drake.effects.effect import Effect, Parameter
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.effects.geometry import GeometryEffect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, basis_over_time
from fbse_drake.effects.sensor import SensorEffect
from fbse_drake.processes import Processes
from fbse_drake.progress import Progress, silent

# So many numbers are kept in columns, at most.
_MOST_NUMBERS = 4_000_000
# What is said meanwhile.
_PREDICTING = "predicting what each effect would do"


@dataclass(frozen=True)
class FixedColumns:
    """What an effect that is no joint torque effect adds on one target."""

    target: str
    # Values of its nonlinear parameters, which are not searched for, (m,).
    nonlinear: np.ndarray
    signature: Signature
    # What the sensors' noise puts into it, where that counts.
    noise: Signature | None


class Dictionary:
    """The effects that could explain one residual; see the module."""

    def __init__(
        self,
        predictor: Predictor,
        effects: Collection[type[Effect]],
        progress: Progress = silent,
    ):
        """Nothing is predicted before it is asked for.

        Args:
            effects: what is tried.
            progress: is told what is being done with the dictionary, too.
        """
        self.predictor, self.progress = predictor, progress
        self._given = tuple(effects)
        self.effects = [effect for effect in effects if not effect.composite]
        # In a log per step it is not known at which velocity within the step a law holds: what such
        # a law leaves is weak evidence.
        self.per_step = not predictor.scenario.recording.is_sampled
        self.joints = predictor.robot.joint_names
        self.travel = travel_of(predictor.motion.signals.joint_position)
        # In which each joint's angle is read, (n,) [rad]; 0 if in none.
        self.steps = np.array([step_of(q) for q in predictor.log["joint/position"].T])
        # How far each joint comes right after it turned, (n,) [rad].
        self.turning = _turning(predictor.motion)
        # The largest of each joint, (n,) [rad/s].
        self.speed = np.abs(predictor.motion.signals.joint_velocity).max(axis=0)
        self.unit = dict(zip(self.joints, predictor.robot.torque_units, strict=True))
        untrusted = untrusted_bodies(predictor.robot, predictor.scenario.identify.inertia)
        self._untrusted = set(untrusted)
        # Inertial parameters that are not trusted are fitted in every explanation, in directions
        # that the log shows; if it shows none, nothing can be said against the model's.
        self.inertia: UntrustedInertia | None = None
        if untrusted:
            self._look_at(untrusted_inertia(predictor.motion, untrusted))
        if self.inertia is not None:
            # Friction is tried as a whole: as long as half of it is missing, inertia is fitted to
            # that half.
            self.effects += [effect for effect in effects if effect is CoulombViscousFriction]
        self._grids: dict[tuple[type[JointTorqueEffect], int], np.ndarray] = {}
        self._shown: dict[tuple[type[JointTorqueEffect], str], bool] = {}
        self._on_target: dict[tuple[type[Effect], str], dict[str, Parameter]] = {}
        self._columns: Memory[np.ndarray] = Memory(_MOST_NUMBERS, np.size)
        self._fixed_beside: Callable[[], list[list[FixedColumns]]] | None = None

    def _look_at(self, inertia: UntrustedInertia) -> None:
        """Finds the directions of inertia that the log shows."""
        self.directions = inertia.visible_directions(WhitenedResidual(self.predictor.residual))
        self.inertia = inertia if self.directions.size else None
        self.inertia_signature = inertia.signature(self.directions)

    def with_inertia(self, inertia: UntrustedInertia) -> "Dictionary":
        """The same with inertia that is measured otherwise."""
        changed = copy(self)
        changed._look_at(inertia)
        return changed

    def parameters(self, effect: type[Effect], *targets: str) -> Mapping[str, Parameter]:
        """An effect's parameters in the units of targets that share values. Of what the model has
        already they may take away."""
        parameters = self._parameters_on(effect, targets[0])
        if not issubclass(effect, JointTorqueEffect):
            return parameters
        believed = {
            name: min(self.predictor.believed_amount(effect, name, joint) for joint in targets)
            for name, parameter in parameters.items()
            if parameter.linear and parameter.bounds[0] == 0.0
        }
        return parameters | {
            name: replace(parameters[name], bounds=(-amount, parameters[name].bounds[1]))
            for name, amount in believed.items()
            if amount > 0.0
        }

    def largest_plausible(self, effect: type[Effect], target: str) -> float:
        """Largest plausible size of an effect's first parameter, which says how strong it is, on a
        target."""
        first = next(iter(self._parameters_on(effect, target).values()))
        return max(abs(bound) for bound in first.plausible)

    def _parameters_on(self, effect: type[Effect], target: str) -> dict[str, Parameter]:
        """See `Effect.parameters_on` and `JointTorqueEffect.parameters_in`."""
        key = effect, target
        if key not in self._on_target:
            parameters = effect.parameters_on(self.predictor.robot, target)
            if issubclass(effect, JointTorqueEffect):
                parameters = effect.parameters_in(self._motion_of(target), parameters)
            self._on_target[key] = parameters
        return self._on_target[key]

    @cached_property
    def joint_effects(self) -> list[type[JointTorqueEffect]]:
        return [effect for effect in self.effects if issubclass(effect, JointTorqueEffect)]

    @cached_property
    def _other_effects(self) -> list[type[Effect]]:
        return [effect for effect in self.effects if not issubclass(effect, JointTorqueEffect)]

    @cached_property
    def groups(self) -> list[tuple[str, ...]]:
        """Joints that may share values: each alone, the same joint of every leg, all."""
        description = self.predictor.robot.description
        wider = [
            group
            for group in (*map(description.counterparts, self.joints), tuple(self.joints))
            if len(group) > 1
        ]
        # Newtons and newton metres have no values in common.
        wider = [group for group in wider if len({self.unit[joint] for joint in group}) == 1]
        return [*((joint,) for joint in self.joints), *dict.fromkeys(wider)]

    def groups_of(self, effect: type[JointTorqueEffect]) -> list[tuple[str, ...]]:
        """Those of the groups all of whose joints can have an effect; of several joints, if the log
        shows in all what it is."""
        allowed = set(self._targets(effect))
        shown = {joint for joint in self.joints if self.is_shown(effect, joint)}
        return [
            group
            for group in self.groups
            if allowed.issuperset(group) and (len(group) == 1 or shown.issuperset(group))
        ]

    def is_shown(self, effect: type[JointTorqueEffect], joint: str) -> bool:
        """Does what a joint did in the log show what an effect is?"""
        key = effect, joint
        if key not in self._shown:
            self._shown[key] = effect.shows_in(self._motion_of(joint))
        return self._shown[key]

    def _motion_of(self, joint: str) -> JointMotion:
        """What one joint did, (N, 1) each."""
        return self.predictor.joint_motion.of_joints(np.array([self.joints.index(joint)]))

    def serves(self, predictor: Predictor, effects: Collection[type[Effect]]) -> bool:
        """Is it of these effects, and of another predictor's model over the same log?"""
        return self._given == tuple(effects) and self.predictor.is_like(predictor)

    def begin(self, processes: Processes) -> None:
        """Begins to predict `fixed` beside other work."""
        # Found once for both processes.
        self.predictor.residual  # noqa: B018
        task = processes.begin(self._fixed)

        def result() -> list[list[FixedColumns]]:
            (found,) = processes.results([task], self.progress, _PREDICTING)
            return found

        self._fixed_beside = result

    @cached_property
    def fixed(self) -> dict[type[Effect], list[FixedColumns]]:
        """All candidates that are no joint torque effects: one for each target that moves the
        residual."""
        found = self._fixed(self.progress) if self._fixed_beside is None else self._fixed_beside()
        return dict(zip(self._other_effects, found, strict=True))

    def _fixed(self, progress: Progress) -> list[list[FixedColumns]]:
        """By effect. (The class of an effect need not be known to another process by its name.)"""
        result = []
        for k, effect in enumerate(self._other_effects):
            progress(_PREDICTING, k / len(self._other_effects))
            result.append([c for target in self._targets(effect) for c in self._on(effect, target)])
        return result

    def _on(self, effect: type[Effect], target: str) -> list[FixedColumns]:
        """Columns of an effect on one target, of several values of its nonlinear parameters where
        these are searched for; none if it moves nothing."""
        usual = self._fixed_columns(effect, target, self.usual_at(effect, target))
        if not len(usual.signature.rows):
            return []
        around = self._around(effect, target) if self.is_of_motion(usual.signature) else []
        return [*(self._fixed_columns(effect, target, values) for values in around), usual]

    def _fixed_columns(
        self, effect: type[Effect], target: str, nonlinear: np.ndarray
    ) -> FixedColumns:
        raw = self.predictor.signature(effect, target, nonlinear)
        raw = replace(
            raw,
            lowest=effect.lowest_values(self.predictor.robot, target),
            prior=effect.linear_beliefs() ** -2,
        )
        is_noisy = len(raw.rows) and (self.is_measured(effect) or issubclass(effect, ContactEffect))
        noise = self.predictor.noise_in(effect, target, nonlinear, raw) if is_noisy else None
        return FixedColumns(target, nonlinear, raw, noise)

    def is_measured(self, effect: type[Effect]) -> bool:
        """Is the noise that is in the columns of an effect in the residual as well?"""
        follows = issubclass(effect, SensorEffect) and effect.follows_load()
        is_noisy = follows and self._is_torque_noisy
        return issubclass(effect, InertiaEffect | GeometryEffect) or is_noisy

    @cached_property
    def _is_torque_noisy(self) -> bool:
        """Commands of steps are known exactly, unless noise is believed to be in them."""
        motion = self.predictor.motion
        noise = motion.torque_variance(motion.signals.torque_command)
        return not self.per_step or bool(noise.any())

    def is_of_motion(self, signature: Signature) -> bool:
        """Does an effect show in a transmission or in standing soles alone? Elsewhere the data
        hardly tell nonlinear parameters of what is no joint torque effect from others: they keep
        their default."""
        rows = self.predictor.motion.rows
        kinds = {rows[row].kind for row in signature.rows}
        return kinds in ({"transmission"}, {"kinematic"})

    def _around(self, effect: type[Effect], target: str) -> list[np.ndarray]:
        """Values over the plausible ranges of nonlinear parameters, (m,) each; none without any."""
        searched = [p for p in self.parameters(effect, target).values() if not p.linear]
        axes = [np.geomspace(*p.plausible, p.grid) for p in searched]
        return [np.array(values) for values in itertools.product(*axes)] if axes else []

    def _targets(self, effect: type[Effect]) -> Sequence[str]:
        """What an effect is tried on. Of bodies whose inertia is not trusted all is fitted
        anyhow."""
        if effect.acts_on == "body":
            suspected = effect.suspected_bodies(self.predictor.robot)
            return [body for body in suspected if body not in self._untrusted]
        driven, motion = self.predictor.is_driven, self.predictor.motion
        if effect.needs_motor_encoder and not motion.signals.motor_position.shape[1]:
            return []
        if effect.needs_sampled_torque and self.per_step:
            return []
        if effect.needs_fixed_base and self.predictor.robot.has_floating_base:
            return []
        return {
            "joint": [
                joint
                for joint, is_driven in zip(self.joints, driven, strict=True)
                if is_driven or not effect.needs_motor
            ],
            "foot": self.predictor.robot.description.sides,
            "robot": ["robot"],
        }[effect.acts_on]

    def rows_of(self, effect: type[JointTorqueEffect], joints: Sequence[str]) -> np.ndarray:
        """Places of the rows in which a joint torque effect on some joints shows, those of their
        torques first; see `Predictor.rows_of`."""
        return self.predictor.rows_of(effect, np.array([self.joints.index(j) for j in joints]))

    def points(self, effect: type[JointTorqueEffect]) -> np.ndarray:
        """First grid of an effect's nonlinear values for each joint, (m, G, n)."""
        of_joint = [
            [p for p in self.parameters(effect, joint).values() if not p.linear]
            for joint in self.joints
        ]
        # All joints have as many, though a value may be known well enough in some.
        grids = [max(p.grid for p in alike) for alike in zip(*of_joint, strict=True)]
        return np.stack([self._points_on(searched, grids) for searched in of_joint], axis=2)

    @staticmethod
    def _points_on(searched: Sequence[Parameter], grids: Sequence[int]) -> np.ndarray:
        """The same of one joint, (m, G), whose axes have grids of these sizes."""
        if not searched:
            return np.zeros((0, 1))
        most = {0: 1, 1: Parameter.grid, 2: 5}.get(sum(grid > 1 for grid in grids), 3)
        # What needs more than the usual points needs them beside others too.
        axes = [
            np.geomspace(*p.plausible, grid if grid > Parameter.grid else min(most, grid))
            if grid > 1
            else np.sqrt(np.prod(p.plausible, keepdims=True))
            for p, grid in zip(searched, grids, strict=True)
        ]
        return np.array(list(itertools.product(*axes))).T

    def grid(self, effect: type[JointTorqueEffect]) -> Iterator[tuple[int, np.ndarray]]:
        """Columns of an effect's first grid, (B, p, G), row by row of all joints."""
        self.progress("predicting what each joint effect would do", self._predicted)
        points = self.points(effect)
        for row in self.rows_of(effect, self.joints):
            key = (effect, int(row))
            columns = self._grids.get(key)
            if columns is None:
                joints = self.predictor.joints_of(np.array([row]))
                made = self.predictor.joint_columns(effect, points[..., joints], np.array([row]))
                columns = np.ascontiguousarray(np.transpose(made[..., 0], (2, 0, 1)))
                self._grids[key] = columns
            yield int(row), columns

    @property
    def _predicted(self) -> float:
        """Share of the joint effects whose grids are there."""
        return len({effect for effect, _ in self._grids}) / max(1, len(self.joint_effects))

    def _factors(self, effect: type[Effect], target: str) -> np.ndarray:
        """What values of the nonlinear parameters at a revolute joint of a usual robot are
        multiplied with for a target, shape (m,)."""
        prismatic, mass = self.unit.get(target) == "N", self.predictor.robot.total_mass
        return np.array(
            [
                (p.lever_factor if prismatic else 1.0)
                * (p.at_prismatic_joint if prismatic else p).factor_with(mass)
                for p in effect.parameters.values()
                if not p.linear
            ]
        )

    def usual_at(self, effect: type[Effect], target: str) -> np.ndarray:
        """Usual values of the nonlinear parameters in the units of a target, as far as they are
        plausible there, (m,)."""
        ranges = [p.plausible for p in self.parameters(effect, target).values() if not p.linear]
        low, high = np.array(ranges).reshape(-1, 2).T
        if issubclass(effect, ContactEffect):
            return np.clip(effect.usual(self.predictor.pad_contact), low, high)
        return np.clip(usual_values(effect) * self._factors(effect, target), low, high)

    def columns(
        self,
        effect: type[JointTorqueEffect],
        places: np.ndarray,
        nonlinear: np.ndarray,
        *,
        noisier: bool = False,
    ) -> np.ndarray:
        """Columns for G sets of nonlinear values, (m, G) or (m, G, r), shape (B, r, p, G); see
        `Predictor.joint_columns`.

        Searches come back to the same values again and again: columns are kept.
        """
        sets = (
            nonlinear
            if nonlinear.ndim == 3
            else np.repeat(nonlinear[:, :, None], len(places), axis=2)
        )
        found = []
        for r, place in enumerate(places):
            keys = [(effect, int(place), values.tobytes(), noisier) for values in sets[..., r].T]
            known = {key: self._columns[key] for key in keys if key in self._columns}
            new = [g for g, key in enumerate(keys) if key not in known]
            if new:
                columns = self.predictor.joint_columns(
                    effect, sets[:, new, r : r + 1], places[r : r + 1], noisier=noisier
                )
                # From (p, G, B, 1).
                made = {
                    keys[g]: np.ascontiguousarray(columns[:, k, :, 0]) for k, g in enumerate(new)
                }
                known |= made
                for key, values in made.items():
                    self._columns[key] = values
            found.append([known[key] for key in keys])
        # From (r, G, p, B).
        return np.transpose(np.array(found), (3, 0, 2, 1))

    @cached_property
    def significance(self) -> Significance:
        """Sizes of effects as shares of what the log's rows are made of."""
        return Significance(self.predictor)

    def follows_torque(self, effect: type[Effect], joints: Sequence[str]) -> bool:
        """Does the reading of joints follow their torques as they were recorded? What makes those
        step, as friction does, is in the readings then."""
        if not (issubclass(effect, SensorEffect) and effect.follows_load()):
            return False
        places = [self.joints.index(joint) for joint in joints]
        return not self.predictor.reading.has_load_of_motion[places].all()

    def takes_torque(self, effect: type[Effect]) -> bool:
        """Does what an effect takes depend on the measured torque?"""
        # The load of inertia that is not trusted is taken from it.
        return depends_on(effect, "command", *(["load"] if self.inertia is not None else []))


@cache
def depends_on(effect: type[Effect], *signals: Literal["command", "load", "position"]) -> bool:
    """Does what a joint effect takes depend on these signals of a joint's motion?"""
    if not issubclass(effect, JointTorqueEffect):
        return False
    time = np.arange(10.0)[:, None]
    torque = np.exp(0.1 * time)
    motion = JointMotion(
        velocity=np.sin(time),
        position=np.cos(time),
        command=torque,
        load=torque,
        time=time,
        time_step=1e-3,
    )
    larger = motion._replace(**{name: 100.0 * getattr(motion, name) for name in signals})
    nonlinear = usual_values(effect)[:, None]
    usual, changed = (basis_over_time(effect, one, nonlinear) for one in (motion, larger))
    return not np.array_equal(usual, changed)


def _turning(motion: RecordedMotion) -> np.ndarray:
    """How far joints come within two averages after they turned, (n,) [rad]; 0 for those that did
    not turn: a torque that is late by less than one has followed by then."""
    velocity, acceleration = motion.blocks.joint_velocity, motion.blocks.joint_acceleration
    turned = (velocity[1:] * velocity[:-1] < 0) & (motion.known[1:, : velocity.shape[1]] > 0)
    at_turns = np.where(turned, np.abs(acceleration[1:]), np.nan)
    usual = np.array(
        [np.nanmedian(a) if of.any() else 0.0 for a, of in zip(at_turns.T, turned.T, strict=True)]
    )
    return 0.5 * usual * (2 * motion.length * motion.period) ** 2


def usual_values(effect: type[Effect]) -> np.ndarray:
    """Usual values of an effect's nonlinear parameters, (m,)."""
    return np.array(
        [
            _default(effect, name)
            for name, parameter in effect.parameters.items()
            if not parameter.linear
        ]
    )


def _default(effect: type[Effect], name: str) -> float:
    """A usual value of a nonlinear parameter: its default, or the middle of its plausible range."""
    value = getattr(effect(), name)
    if isinstance(value, dict):
        value = value.get("all", np.sqrt(np.prod(effect.parameters[name].plausible)))
    return float(value)
