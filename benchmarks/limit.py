"""How good a friction estimate can be at best: `python -m benchmarks.limit [SCENARIO]`.

The posterior Cramer-Rao bound (P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao
bounds for discrete-time nonlinear filtering", IEEE Trans. Signal Processing 46, 1998) of the
friction torque, from the sensors of a simulated walk. With Gaussian noise and small errors it is
the covariance of the Kalman filter with the true models, linearised about the true motion. The
smoother's, which sees the whole walk before it answers, stands beside it.

What the limit knows, and what not:

- The plant's own discrete equation of motion, all rows, with contact forces as inputs. It has no
  process noise. Posture and attitude are taken as known, so inertia, Jacobians and gravity are
  exact; Coriolis terms do not change with the errors of the velocities.
- Sensors: velocities of the encoders, gyro, accelerometer and the forces under the feet, with the
  noise that they have, in every step. Biases are known. What rounded angles tell is left out.
- Which pads touch the ground. A foot that carries at least 5 % of the weight stands still, but for
  white noise as large as its motion in this walk under such a load. No contact law.
- Commands are exact.
- Friction: its true law, with the nonlinear parameters known. The linear parameters are constant
  and as uncertain at the start as those of `WholeBody`. "With walk", a random walk is added to the
  law's torque, as `WholeBody` believes for the sake of what no law explains. That is the limit
  where friction does walk so. In a simulation it follows its law, and the best filter that expects
  a walk errs less there, by up to a third.

Whatever is taken as known makes the limit smaller, so an estimator that has to find it out is
above. Two assumptions can make it too large: that angles tell nothing of velocities, and that feet
move as white noise. With angles that have white noise instead of rounding, the hip yaw's limit in
swing falls by 1 %; with feet that stand perfectly still, from 0.039 to 0.030 (`paper_walk_fbse`,
first 4.3 s). Of joints that move much, the limit without walk is below what simulated friction
differs from its law (up to 1 %), and so out of reach.

The estimate is the scenario's own, in the loop. Options: [--seeds N] [--duration SECONDS]
[--out DIR]. Prints rms values over the seeds, stance and swing as planned, and writes
DIR/limit.json. A seed of the whole walk takes about a minute.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable
from rich.console import Console
from rich.progress import track
from scipy.linalg import cho_factor, cho_solve

from benchmarks.console import print_table
from fbse_drake import Log, Scenario, load_scenario, simulate
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.errors import InputError
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.whole_body import WholeBody
from fbse_drake.files import write_json
from fbse_drake.report.html import Table
from fbse_drake.report.metrics import (
    ended_step,
    friction_error,
    joint_sides,
    settled,
    stance,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import build_robot

# A foot stands while it carries at least the first of these shares of the feet's mean load; between
# one and the next it moves equally much.
_LOAD_SHARES = (0.05, 0.1, 0.2, 0.5)
# Standard deviation of velocities before the first measurement [rad/s, m/s].
_UNKNOWN_VELOCITY = 1.0
# So many rows' covariances are kept at a time; the smoother computes them a second time.
_KEPT = 200


class Step(NamedTuple):
    """One step of a linear model with N states and c measurements:

    x' = transition x + drive w and y = after x' + before x + e, with w standard normal.
    """

    # Shapes (N, N), (N, m), (c, N) and (c, N).
    transition: np.ndarray
    drive: np.ndarray
    after: np.ndarray
    before: np.ndarray
    # Of the independent errors e, (c,).
    variance: np.ndarray

    @property
    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        """What is measured of x, (c, N), and of w, (c, m)."""
        return self.after @ self.transition + self.before, self.after @ self.drive


def filtered_covariance(P: np.ndarray, step: Step) -> np.ndarray:
    """Covariance of the states after a step, given all measurements until then, (N, N).

    Args:
        P: the same before the step.
    """
    F, G = step.transition, step.drive
    C, D = step.measured
    FP = F @ P
    gain = FP @ C.T + G @ D.T
    S = C @ P @ C.T + D @ D.T + np.diag(step.variance)
    P_new = FP @ F.T + G @ G.T - gain @ cho_solve(cho_factor(S), gain.T)
    return 0.5 * (P_new + P_new.T)


def future_information(information: np.ndarray, step: Step) -> np.ndarray:
    """Information about the states before a step in its measurement and all later ones, (N, N).

    Args:
        information: about the states after the step, in what is measured later.
    """
    F, G = step.transition, step.drive
    C, D = step.measured
    of_F, of_G = information @ F, information @ G
    weighted_C, weighted_D = C.T / step.variance, D.T / step.variance
    about_x = weighted_C @ C + F.T @ of_F
    shared = weighted_C @ D + F.T @ of_G
    about_w = np.eye(G.shape[1]) + weighted_D @ D + G.T @ of_G
    result = about_x - shared @ cho_solve(cho_factor(about_w), shared.T)
    return 0.5 * (result + result.T)


def smoothed_covariance(P: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Covariance (N, N) that is left of P with independent information (N, N)."""
    return np.linalg.solve(np.eye(len(P)) + P @ information, P)


class Noise(NamedTuple):
    """Standard deviations of the sensors: joint velocity, gyro [rad/s], accelerometer [m/s^2]."""

    joint_velocity: float
    angular_velocity: float
    acceleration: float


class FrictionPrior(NamedTuple):
    """What is known of the friction before it is measured."""

    # Standard deviation of every linear parameter of the law [its unit].
    parameter: float
    # Random walk beside the law [Nm/sqrt(s)], and standard deviation of where it starts [Nm].
    walk: float = 0.0
    start: float = 0.0


@dataclass(frozen=True)
class WalkModel:
    """A walk as a linear model: its equations, linearised about the true motion.

    K rows, n joints, v velocities, m parameters of each joint's friction law. The velocities of the
    base are in world axes. The states are errors of the v velocities, of the n m parameters and of
    the n torques that the law does not explain, after the step that ends in a row.
    """

    period: float
    noise: Noise
    prior: FrictionPrior
    # Places of the joints in the velocities, (n,).
    joint: np.ndarray
    # Mass matrix (K, v, v), and Jacobians [angular, linear] of the IMU in world axes (K, 6, v) and
    # of each sole in its own (K, feet, 6, v).
    mass_matrix: np.ndarray
    imu_jacobian: np.ndarray
    sole_jacobian: np.ndarray
    # Torque of the friction law per parameter (K, n, m), and its slope (K, n) [Nm s/rad].
    basis: np.ndarray
    slope: np.ndarray
    # Noise of each foot's measured wrench in the step that ends in a row, of independent unit
    # normal numbers (K, feet, 6, columns) [Nm, N].
    wrench_noise: np.ndarray
    # Standard deviation of each sole's motion [angular, linear], (K, feet, 6) [rad/s, m/s];
    # infinite for a foot that does not stand.
    foot_motion: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """Covariance of the states in the first row."""
        n, m = self.basis.shape[1:]
        sizes = (self.mass_matrix.shape[1], n * m, n)
        deviations = (_UNKNOWN_VELOCITY, self.prior.parameter, self.prior.start)
        return np.diag(np.repeat(deviations, sizes) ** 2)

    def friction(self, row: int) -> np.ndarray:
        """Error of the friction in the step that ends in a row, per state, (n, states)."""
        n, m = self.basis.shape[1:]
        of_velocity = np.zeros((n, self.mass_matrix.shape[1]))
        of_velocity[np.arange(n), self.joint] = self.slope[row]
        of_parameters = (np.eye(n)[:, :, None] * self.basis[row]).reshape(n, n * m)
        return np.hstack([of_velocity, of_parameters, np.eye(n)])

    def step(self, row: int) -> Step:
        """The step that ends in a row."""
        n, v = len(self.joint), self.mass_matrix.shape[1]
        friction, inertia = self.friction(row), self.mass_matrix[row - 1] / self.period
        states = friction.shape[1]
        # inertia (V' - V) = wrenches - friction, where the friction has the velocities V'.
        implicit = inertia.copy()
        implicit[self.joint] += friction[:, :v]
        force = np.zeros((v, states))
        force[:, :v] = inertia
        force[self.joint, v:] -= friction[:, v:]
        walk = np.zeros((states, n))
        walk[-n:] = self.prior.walk * np.sqrt(self.period) * np.eye(n)
        wrench = np.einsum("fiv,fic->vfc", self.sole_jacobian[row - 1], self.wrench_noise[row])
        driven = np.hstack([wrench.reshape(v, -1), force @ walk])
        solved = np.linalg.solve(implicit, np.hstack([force, driven]))
        transition = np.eye(states)
        transition[:v] = solved[:, :states]
        drive = np.hstack([np.zeros((states, driven.shape[1] - n)), walk])
        drive[:v] = solved[:, states:]
        return Step(transition, drive, *self._measurement(row, states))

    def _measurement(self, row: int, states: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`after`, `before` and `variance` of a step."""
        n, v = len(self.joint), self.mass_matrix.shape[1]
        angular, linear = np.split(self.imu_jacobian[row], 2)
        stands = np.isfinite(self.foot_motion[row])
        feet = self.sole_jacobian[row][stands]
        acceleration = slice(n + 3, n + 6)
        after = np.zeros((n + 6 + len(feet), states))
        after[:, :v] = np.vstack([np.eye(v)[self.joint], angular, linear / self.period, feet])
        before = np.zeros_like(after)
        before[acceleration, :v] = -linear / self.period
        deviation = np.repeat(self.noise, (n, 3, 3))
        return after, before, np.append(deviation, self.foot_motion[row][stands]) ** 2

    def filtered_variance(self) -> np.ndarray:
        """Variance of the friction's error, given all measurements until its step ends, (K, n).

        [Nm^2]; NaN in the first row, in which no step ends.
        """
        rows, result = range(1, len(self.slope)), np.full_like(self.slope, np.nan)
        for row, P in zip(rows, self._covariances(self.start, rows), strict=True):
            result[row] = _variance(self.friction(row), P)
        return result

    def smoothed_variance(self) -> np.ndarray:
        """As `filtered_variance`, given all measurements of the walk."""
        rows, result = range(1, len(self.slope)), np.full_like(self.slope, np.nan)
        parts = [rows[start : start + _KEPT] for start in range(0, len(rows), _KEPT)]
        starts = [self.start]
        for part in parts:
            *_, last = self._covariances(starts[-1], part)
            starts.append(last)
        information = np.zeros_like(self.start)
        for part, start in reversed(list(zip(parts, starts[:-1], strict=True))):
            covariances = list(self._covariances(start, part))
            for row, P in reversed(list(zip(part, covariances, strict=True))):
                left = smoothed_covariance(P, information)
                result[row] = _variance(self.friction(row), left)
                information = future_information(information, self.step(row))
        return result

    def _covariances(self, P: np.ndarray, rows: range) -> Iterator[np.ndarray]:
        """Of the states after each of these steps, from that before the first."""
        for row in rows:
            P = filtered_covariance(P, self.step(row))
            yield P


def _variance(readout: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.einsum("ij,jk,ik->i", readout, P, readout)


def walk_model(scenario: Scenario, log: Log, prior: FrictionPrior) -> WalkModel:
    """The linear model of a simulated walk.

    Args:
        log: of the scenario's simulation, with truth.

    Raises:
        InputError: sensors, periods or effects for which the limit is not known.
    """
    require_known(scenario)
    robot, sensors = build_robot(scenario.robot), scenario.sensors
    mass_matrix, imu_jacobian, sole_jacobian, velocity = _along(robot, log)
    sides = robot.description.sides
    force = [log[f"truth/foot/{side}/pad_force"] for side in sides]
    wrench_noise = []
    for side, G, on_pads in zip(sides, robot.grasp_maps, force, strict=True):
        if robot.description.legs[side].has_six_axes:
            deviations = (sensors.foot_force.moment_noise, sensors.foot_force.noise)
            G, touches = np.diag(np.repeat(deviations, 3)), on_pads.any(axis=(1, 2))[:, None]
        else:
            G, touches = sensors.foot_force.noise * G, np.repeat(on_pads.any(axis=2), 3, axis=1)
        wrench_noise.append(G * touches[:, None, :])
    load = np.stack([on_pads[:, :, 2].sum(axis=1) for on_pads in force], axis=1)
    motion = np.einsum("kfiv,kv->kfi", sole_jacobian, velocity)
    basis, slope = _law(scenario, robot, log["truth/joint/velocity"])
    return WalkModel(
        period=log.meta["period"],
        noise=Noise(
            sensors.encoders.velocity_noise,
            sensors.imu.angular_velocity_noise,
            sensors.imu.acceleration_noise,
        ),
        prior=prior,
        joint=robot.velocity_index,
        mass_matrix=mass_matrix,
        imu_jacobian=imu_jacobian,
        sole_jacobian=sole_jacobian,
        basis=basis,
        slope=slope,
        wrench_noise=np.stack(wrench_noise, axis=1),
        foot_motion=foot_motion(motion, load / load.sum(axis=1).mean()),
    )


def foot_motion(motion: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Root mean square of feet's motion at loads like the present one, (K, feet, 6).

    Args:
        motion: twist of each sole, (K, feet, 6) [rad/s, m/s].
        load: of each foot, as a share of the mean load of all, (K, feet).

    Returns:
        Infinite for a foot that does not stand.
    """
    result, kind = np.full_like(motion, np.inf), np.digitize(load, _LOAD_SHARES)
    for standing in range(1, len(_LOAD_SHARES) + 1):
        alike = kind == standing
        if alike.any():
            result[alike] = np.sqrt(np.mean(motion[alike] ** 2, axis=0))
    return result


def require_known(scenario: Scenario) -> None:
    """Raises InputError for a scenario whose limit is not known."""
    if isinstance(scenario.estimator, NoEstimator):
        raise InputError("estimator: the scenario has none to compare (estimator: !Fbse {})")
    encoders, imu, step = scenario.sensors.encoders, scenario.sensors.imu, scenario.plant.time_step
    if encoders.velocity != "exact":
        raise InputError(f"sensors.encoders.velocity: expected exact, found {encoders.velocity}")
    positive = {
        "encoders.velocity_noise": encoders.velocity_noise,
        "imu.angular_velocity_noise": imu.angular_velocity_noise,
        "imu.acceleration_noise": imu.acceleration_noise,
    }
    for key, noise in positive.items():
        if noise <= 0:
            raise InputError(f"sensors.{key}: the limit needs a number > 0, found {noise:g}")
    periods = {"log.period": scenario.log.period, "control.period": scenario.control.period}
    for name, sensor in scenario.sensors.by_name.items():
        if hasattr(sensor, "period"):
            periods[f"sensors.{name}.period"] = sensor.period
    for key, period in periods.items():
        if abs(period - step) > 1e-9:
            raise InputError(f"{key}: the limit needs the plant's step, {step:g}; found {period:g}")


def _along(robot: Robot, log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mass matrix, Jacobians of IMU and soles, and velocities of a log's true motion."""
    if not robot.has_floating_base or not robot.description.legs:
        raise InputError("robot: the limit is that of a robot on feet, with a floating base")
    plant, world = robot.plant, robot.plant.world_frame()
    context, origin, wrt = plant.CreateDefaultContext(), np.zeros(3), JacobianWrtVariable.kV
    soles = [robot.sole(side) for side in robot.description.sides]
    frames = [(robot.imu, world), *((sole, sole) for sole in soles)]
    twist = np.hstack([log["truth/base/angular_velocity"], log["truth/base/velocity"]])
    rows = []
    for k in range(len(log.time)):
        orientation = Quaternion(wxyz=log["truth/base/orientation"][k])
        X_WB = RigidTransform(orientation, log["truth/base/position"][k])
        q, v = (log[f"truth/joint/{name}"][k] for name in ("position", "velocity"))
        robot.set_state(context, q, v, X_WB, twist[k])
        imu, *feet = (
            plant.CalcJacobianSpatialVelocity(context, wrt, frame, origin, world, axes)
            for frame, axes in frames
        )
        rows.append((plant.CalcMassMatrix(context), imu, feet, plant.GetVelocities(context)))
    mass_matrix, imu, feet, velocity = (np.array(part) for part in zip(*rows, strict=True))
    return mass_matrix, imu, feet, velocity


def _law(scenario: Scenario, robot: Robot, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque per parameter (K, n, m) and slope (K, n) of all friction at velocities (K, n)."""
    basis, slope = [], np.zeros_like(velocity)
    for effect in scenario.robot.effects_of(JointTorqueEffect, robot.description, key="robot"):
        if not effect.effect.of_velocity_alone:
            raise InputError(
                "robot.effects: the limit is that of friction that depends on the velocity alone, "
                f"found {effect.effect.__name__}"
            )
        torques, slopes = effect.effect.basis(JointMotion(velocity), effect.nonlinear[:, None])
        basis += [np.broadcast_to(torque, velocity.shape) for torque in torques]
        slope += sum(value * at for value, at in zip(effect.linear, slopes, strict=True))
    if not basis:
        raise InputError("robot.effects: expected joint friction, found none")
    return np.stack(basis, axis=-1), slope


def priors(scenario: Scenario) -> dict[str, FrictionPrior]:
    """The prior without and with the random walk of the scenario's friction estimator."""
    believed: WholeBody | ModelAided = WholeBody()
    if isinstance(scenario.estimator, Fbse):
        friction = scenario.estimator.friction
        believed = friction if isinstance(friction, WholeBody | ModelAided) else believed
    law = FrictionPrior(believed.parameter_uncertainty)
    walk, start = believed.disturbance_walk, believed.disturbance_uncertainty
    return {"law": law, "with walk": law._replace(walk=walk, start=start)}


@dataclass(frozen=True)
class Row:
    """A joint in a phase: mean squares over time [Nm^2]."""

    joint: str
    phase: str
    friction: float
    limit: float
    smoother: float
    limit_with_walk: float
    ours: float

    @property
    def ratio(self) -> float:
        """Our error over the limit [1]."""
        return float(np.sqrt(self.ours / self.limit))

    @property
    def ratio_with_walk(self) -> float:
        """Our error over the limit for a friction that walks [1]."""
        return float(np.sqrt(self.ours / self.limit_with_walk))

    def nrmse(self, name: str) -> float:
        """An error's rms over that of the friction [1]."""
        return float(np.sqrt(getattr(self, name) / self.friction))


def rows_of(scenario: Scenario, log: Log) -> list[Row]:
    """Limits and our error in a log of the scenario's simulation, for each joint and phase."""
    known = priors(scenario)
    model = walk_model(scenario, log, known["law"])
    squares = {
        "friction": ended_step(log, "truth/joint/friction_torque") ** 2,
        "limit": model.filtered_variance(),
        "smoother": model.smoothed_variance(),
        "limit_with_walk": replace(model, prior=known["with walk"]).filtered_variance(),
        "ours": friction_error(log) ** 2,
    }
    stands, rows = stance(log), []
    for phase in ("stance", "swing"):
        for number, (joint, side) in enumerate(zip(log.joints, joint_sides(log), strict=True)):
            if side not in stands:
                continue
            counted = settled(log) & (stands[side] == (phase == "stance"))
            if not counted.any():
                continue
            means = {name: np.mean(values[counted, number]) for name, values in squares.items()}
            rows.append(Row(joint, phase, **{name: float(mean) for name, mean in means.items()}))
    return rows


def pooled(rows: Sequence[Row]) -> Row:
    """Means over rows, under the name of the first."""
    names = ("friction", "limit", "smoother", "limit_with_walk", "ours")
    means = {name: float(np.mean([getattr(row, name) for row in rows])) for name in names}
    return replace(rows[0], **means)


def table(rows: Sequence[Row]) -> Table:
    """A line for each of these rows."""
    header = ("Joint", "leg in", "friction [Nm]", "limit [Nm]", "limit, NRMSE", "smoother")
    header += ("limit with walk", "ours", "ours / limit", "ours / limit with walk")
    lines = []
    for row in rows:
        sizes = (float(np.sqrt(row.friction)), float(np.sqrt(row.limit)))
        errors = [row.nrmse(name) for name in ("limit", "smoother", "limit_with_walk", "ours")]
        lines.append((row.joint, row.phase, *sizes, *errors, row.ratio, row.ratio_with_walk))
    return Table(header, tuple(lines))


def headline(rows: Sequence[Row]) -> str:
    """How far the hip yaws are from their limit while they swing; empty without hip yaws."""
    yaws = [row for row in rows if row.joint.endswith("hip_yaw") and row.phase == "swing"]
    if not yaws:
        return ""
    yaw = pooled(yaws)
    return (
        f"Hip yaw in swing: NRMSE {yaw.nrmse('ours'):.3f}, {yaw.ratio:.1f} times the limit of "
        f"{yaw.nrmse('limit'):.3f} ({yaw.ratio_with_walk:.1f} times that with walk, "
        f"{yaw.nrmse('limit_with_walk'):.3f})"
    )


def run(scenario: str, seed: int, duration: float | None) -> list[Row]:
    """Simulates a scenario with a seed, for a duration [s] or its own; see `rows_of`."""
    overrides = [f"seed={seed}", *([] if duration is None else [f"duration={duration}"])]
    loaded = load_scenario(scenario, overrides=overrides)
    require_known(loaded)
    return rows_of(loaded, simulate(loaded).log)


def main(arguments: Sequence[str] | None = None) -> None:
    """Computes the limits and prints the table."""
    parser = argparse.ArgumentParser(description="How good a friction estimate can be at best.")
    parser.add_argument("scenario", nargs="?", default="paper_walk_fbse", help="name or path")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds (default 1)")
    parser.add_argument("--duration", type=float, help="of the walk [s] (default the scenario's)")
    parser.add_argument("--out", type=Path, default=Path("out/fbse"), help="default out/fbse")
    options = parser.parse_args(arguments)
    console = Console(width=150)
    seeds = track(range(options.seeds), description="walking", console=console)
    try:
        by_seed = [run(options.scenario, seed, options.duration) for seed in seeds]
    except InputError as error:
        parser.error(str(error))
    rows = [pooled(of_seeds) for of_seeds in zip(*by_seed, strict=True)]
    title = f"{options.scenario}: smallest error of the friction, {options.seeds} seed(s)"
    print_table(console, title, table(rows))
    if headline(rows):
        console.print(headline(rows), highlight=False)
    options.out.mkdir(parents=True, exist_ok=True)
    records = [asdict(row) | {"seed": seed} for seed, of in enumerate(by_seed) for row in of]
    path = options.out / "limit.json"
    write_json(path, records)
    console.print(f"Mean squares of every seed: {path}", highlight=False)


if __name__ == "__main__":
    main()
