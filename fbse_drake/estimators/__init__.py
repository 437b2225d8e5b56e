"""Estimators; importing the package fills their library."""

from fbse_drake.estimators import (
    adaptive_friction,
    disturbance_observer,
    fbse,
    fixed_friction,
    fuzzy,
    lugre,
    radial_basis,
    torque_sensor,
    true_friction,
)

__all__ = [
    "adaptive_friction",
    "disturbance_observer",
    "fbse",
    "fixed_friction",
    "fuzzy",
    "lugre",
    "radial_basis",
    "torque_sensor",
    "true_friction",
]
