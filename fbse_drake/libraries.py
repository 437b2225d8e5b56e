"""The libraries of everything that a scenario can name, by class name; with those of a user's own
that have been imported."""

from fbse_drake.control.compensation import library as compensations_by_name
from fbse_drake.effects.effect import library as effects_by_name
from fbse_drake.estimators.estimator import library as estimators_by_name
from fbse_drake.sensors.sensor import library as sensors_by_name

__all__ = ["compensations_by_name", "effects_by_name", "estimators_by_name", "sensors_by_name"]
