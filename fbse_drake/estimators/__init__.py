"""Estimators; importing the package fills their library."""

from fbse_drake.estimators import (
    disturbance_observer,
    fbse,
    fixed_friction,
    torque_sensor,
    true_friction,
)

__all__ = ["disturbance_observer", "fbse", "fixed_friction", "torque_sensor", "true_friction"]
