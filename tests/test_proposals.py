"""Which candidates a search looks at: none that could come up to what is wanted is passed over."""

import numpy as np
import pytest
from conftest import swinging_legs
from recorded_arm import ARM
from test_regression import white_of

from benchmarks.recorded.course import Course, inverse_dynamics
from fbse_drake import Log
from fbse_drake.discrepancy.diagnosis import selection
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import Fits, fixed_gain
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals, largest_drop
from fbse_drake.discrepancy.diagnosis.remainder import Remainder
from fbse_drake.discrepancy.identification.regression import Regression, Signature
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import CoulombFriction, StribeckFriction, ViscousFriction

BLOCKS, ROWS = 400, 3


def bound_and_drop(residual: np.ndarray, columns: np.ndarray) -> tuple[float, float]:
    """The largest drop of the deviance that is held possible for columns (B, R, p) beside one that
    is in the first row already, and the drop that they bring."""
    white = white_of(residual)
    regression, rng = Regression(white), np.random.default_rng(1)
    known = Signature(np.array([0]), rng.normal(size=(BLOCKS, 1, 1)))
    added = Signature(np.arange(ROWS), columns)
    before, after = regression.fit([known]), regression.fit([known, added])
    beside = Remainder(regression, (known,), before.parameters, white.scale(before.sse), tied=False)
    alone = [fixed_gain(*of_row) for of_row in beside.moments(added)]
    bound = largest_drop(white, before.sse, added.rows, alone)
    return bound, white.deviance(before.sse) - white.deviance(after.sse)


@pytest.mark.parametrize("seed", range(20))
def test_no_fit_takes_off_more_than_is_held_possible(seed: int) -> None:
    """Rows at the noise, below it and far above it."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(BLOCKS, ROWS, 2)) * 10.0 ** rng.uniform(-2, 2, ROWS)[:, None]
    residual = rng.normal(size=(BLOCKS, ROWS)) * 10.0 ** rng.uniform(-0.5, 1.5, ROWS)
    residual += columns @ rng.normal(size=2) * rng.integers(0, 2, ROWS)
    bound, drop = bound_and_drop(residual, columns)
    assert drop <= bound * (1 + 1e-9) + 1e-6


def test_in_one_row_that_is_what_a_fit_takes_off() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(BLOCKS, ROWS, 1)) * [[1.0], [0.0], [0.0]]
    residual = rng.normal(size=(BLOCKS, ROWS)) + 5.0 * columns[:, :, 0]
    bound, drop = bound_and_drop(residual, columns)
    assert drop > 1000
    assert bound == pytest.approx(drop, rel=1e-6)


def test_a_row_that_gains_much_is_not_weighed_down_by_one_that_does_not() -> None:
    """The first row asks for an amount of 10, the others for none. As rows are weighed before the
    fit, it brings little; but once the first row is explained, that counts for more."""
    rng = np.random.default_rng(0)
    columns = np.tile(rng.normal(size=(BLOCKS, 1, 1)), (1, ROWS, 1))
    columns[:, 1:] *= 0.15
    residual = rng.normal(size=(BLOCKS, ROWS))
    residual[:, 0] += 10.0 * columns[:, 0, 0]
    bound, drop = bound_and_drop(residual, columns)
    assert 500 < drop <= bound


def test_what_frees_a_member_from_its_bound_may_take_off_all_of_it() -> None:
    """A joint mostly turns forwards: beside a constant torque it has friction, which would be
    negative without it and is held at none."""
    joint, time = ARM.joints[0], ARM.course().time
    robot = ARM.robot(ARM.by_joint(ARM.rotor_inertia))
    position, velocity, acceleration = ARM.motion(1, time)
    position[:, 0] += 1.5 * time
    velocity[:, 0] += 1.5
    torque = inverse_dynamics(robot, position, velocity, acceleration)
    course = Course(time, position, velocity, acceleration, torque)
    assert 0.5 < np.sign(velocity[:, 0]).mean() < 0.95
    lost = np.zeros_like(torque)
    lost[:, 0] = -150.0 + 20.0 * np.tanh(velocity[:, 0] / 0.01)
    log = ARM.log(course, torque + lost)
    proposals = Proposals(Fits(Dictionary(ARM.predictor(log), [CoulombFriction, TorqueBias])))
    both = proposals.fits.explain([])
    for effect in (TorqueBias, CoulombFriction):
        both = proposals.beside(both, effect, (joint,))
    base = proposals.fits.explain([c for c in both.candidates if c.effect is CoulombFriction])
    assert both.values(both.candidates[-1])[0]["coulomb"] == pytest.approx(20.0, rel=0.02)
    assert base.values(base.candidates[0])[0]["coulomb"] == 0.0
    drop = base.deviance - both.deviance
    assert drop > 1000
    found = [c for c in proposals.promising(base, None, drop) if c.targets == (joint,)]
    assert [c.effect for c in found] == [TorqueBias]


def test_rivals_may_be_on_those_joints_of_a_group_that_are_free() -> None:
    """An effect of all joints may stand for another one that some of them have already."""
    course = ARM.course(1)
    viscous = np.array([30.0, 20.0, 10.0, 0.5, 0.5, 0.5])
    log = ARM.log(course, course.torque + viscous * course.velocity)
    proposals = Proposals(Fits(Dictionary(ARM.predictor(log), [ViscousFriction])))
    base = proposals.fits.explain([])
    for joint in ARM.joints[:3]:
        base = proposals.beside(base, ViscousFriction, (joint,))
    free = tuple(ARM.joints[3:])

    def targets(*, in_part: bool) -> set[tuple[str, ...]]:
        return {c.targets for c in proposals.promising(base, None, in_part=in_part)}

    assert targets(in_part=False) == {(joint,) for joint in free}
    assert targets(in_part=True) == {free, *((joint,) for joint in free)}


def test_what_is_far_behind_a_law_that_cannot_be_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a torque that is there at low speed alone Coulomb friction takes a small part of what
    Stribeck friction does; where that is refused, the small part counts."""
    scenario, log = swinging_legs(12, 0.05)
    place, torque = log.joints.index("left_knee_pitch"), log["joint/torque_command"].copy()
    velocity = log["joint/velocity"][:, place]
    torque[:, place] += 3.0 * np.tanh(velocity / 0.01) * np.exp(-((velocity / 0.1) ** 2))
    torque += 0.05 * np.random.default_rng(3).standard_normal(torque.shape)
    log = Log(log.channels | {"joint/torque_command": torque}, log.meta)
    fits = Fits(Dictionary(Predictor(scenario, log), [CoulombFriction, StribeckFriction]))

    def found() -> set[type[Effect]]:
        additions = selection.best_additions(Proposals(fits), fits.explain([]))
        return {e.candidates[-1].effect for e in additions}

    assert found() == {StribeckFriction}
    significant = selection.is_significant

    def refusing(of: Fits, base: Explanation, wider: Explanation, added: Candidate) -> bool:
        return added.effect is not StribeckFriction and significant(of, base, wider, added)

    monkeypatch.setattr(selection, "is_significant", refusing)
    assert found() == {CoulombFriction}
