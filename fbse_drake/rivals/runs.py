"""The runs of a comparison: tuning, watching and feeding back; each is a run of a campaign.

All methods watch the same logs, so they see the same walk and the same noise. A log is of one case
and one seed; of what happens in the case nobody is told. What a method is worth in the loop is
shown by walks of its own, in which its estimate is compensated.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_load

from fbse_drake.campaign.steps import Material
from fbse_drake.control.compensation import IntegralCompensation, NoCompensation
from fbse_drake.estimation import estimate
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.estimators.true_friction import TrueFriction
from fbse_drake.log import Log
from fbse_drake.report.metrics import friction_nrmse, joint_tracking_rms
from fbse_drake.resources import package_checksum
from fbse_drake.rivals.cases import CASES, NOMINAL, without_friction
from fbse_drake.rivals.methods import (
    Method,
    Tuned,
    counted,
    measured,
    tune,
    tuning_walk,
    with_friction,
)
from fbse_drake.scenario import Scenario, ScenarioTree
from fbse_drake.simulation import simulate

# Walks that no method is in, beside which those with one are seen.
UNCOMPENSATED, ORACLE, FRICTIONLESS = "no compensation", "true friction", "no friction"
REFERENCES = (UNCOMPENSATED, ORACLE, FRICTIONLESS)
# The centre of mass is kept at this distance [s].
_COM_PERIOD = 0.01
# So many ticks of each method are timed, alone.
_TIMED_TICKS = 300


def tuning(material: Material, scenario: str, log: str, trials: int) -> dict[str, str]:
    """Tunes the method of a run; see `StoredRuns`.

    Args:
        scenario: see `scenario_of`.
        log: path of that of the tuning walk, with FBSE's estimates.
        trials: see `tune`.
    """
    method = Method.read(material.values["method"])
    walk = tuning_walk(measured(scenario_of(scenario)))
    tuned = tune(method, walk, Log.load(Path(log)), trials)
    return _result(vars(tuned) | {"method": tuned.method.text})


def read_tuned(result: Mapping[str, Any]) -> Tuned:
    """What `tuning` has found."""
    return Tuned(**{**result, "method": Method.read(result["method"])})


def watching(material: Material, scenario: str, methods: list[str]) -> dict[str, str]:
    """Lets all methods watch the walk of a run, a case with a seed; see `StoredRuns`.

    Args:
        scenario: see `scenario_of`.
        methods: YAML of each, with its settings.
    """
    told = replace(measured(scenario_of(scenario)), seed=material.seed)
    happens = CASES[material.values["case"]](told)
    simulated = simulate(unobserved(happens))
    log, readers = simulated.log, list(map(Method.read, methods))
    estimators = [method.estimator for method in readers]
    watched: dict[str, dict[str, Any]] = {
        method.name: {"nrmse": friction_nrmse(counted(estimated))}
        for method, estimated in zip(readers, with_friction(told, estimators, log), strict=True)
    }
    if material.values["case"] == NOMINAL:
        begin = log.part(slice(0, _TIMED_TICKS))
        for method in readers:
            alone = estimate(replace(told, estimator=method.estimator), begin)
            watched[method.name]["tick"] = 1e6 * float(np.median(alone.tick_time))
    return _result({"failure": simulated.failure, "watched": watched})


def feeding_back(material: Material, scenario: str) -> dict[str, str]:
    """Walks with the friction compensated as the method of a run estimates it, or as a reference.

    Args:
        scenario: see `scenario_of`.
    """
    walk = replace(measured(scenario_of(scenario)), seed=material.seed)
    who = material.values["method"]
    if who in (UNCOMPENSATED, FRICTIONLESS):
        walk = unobserved(walk if who == UNCOMPENSATED else without_friction(walk))
    else:
        estimator = TrueFriction() if who == ORACLE else Method.read(who).estimator
        walk = replace(walk, estimator=estimator, compensation=compensation(walk))
    simulated = simulate(walk)
    log = simulated.log
    stride = max(1, round(_COM_PERIOD / float(log.meta["period"])))
    return _result(
        {
            "failure": simulated.failure,
            "tracking": float(np.mean(joint_tracking_rms(log))),
            "com": _centre_of_mass(log)[::stride].tolist(),
        }
    )


def compensation(scenario: Scenario) -> Any:
    """The scenario's, or the paper's integral law where it has none."""
    own = scenario.compensation
    return own if own.uses_estimate else IntegralCompensation()


def scenario_of(text: str) -> Scenario:
    """The scenario that `dump_scenario` has made a text of."""
    ((name, tree),) = yaml_load(data=text).items()
    return ScenarioTree(name, Path("scenario.yaml"), tree).build()


def unobserved(scenario: Scenario) -> Scenario:
    """The scenario without an estimator."""
    return replace(scenario, estimator=NoEstimator(), compensation=NoCompensation())


def _centre_of_mass(log: Log) -> np.ndarray:
    return log["truth/com/position"][:, :2]


def _result(result: Mapping[str, Any]) -> dict[str, str]:
    return {"sources": package_checksum(), "result": json.dumps(result)}
