"""Estimators; importing the package fills their library."""

from fbse_drake.estimators import (
    actuator_fault,
    adaptive_friction,
    base_sensor,
    disturbance_observer,
    extended_state,
    fbse,
    filtered_model,
    fixed_friction,
    fuzzy,
    lugre,
    network_friction,
    q_filter,
    radial_basis,
    torque_sensor,
    true_friction,
)

__all__ = [
    "actuator_fault",
    "adaptive_friction",
    "base_sensor",
    "disturbance_observer",
    "extended_state",
    "fbse",
    "filtered_model",
    "fixed_friction",
    "fuzzy",
    "lugre",
    "network_friction",
    "q_filter",
    "radial_basis",
    "torque_sensor",
    "true_friction",
]
