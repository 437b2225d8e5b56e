"""Physical effects; importing the package fills the library."""

from fbse_drake.effects import (
    actuation,
    contact,
    counterbalance,
    friction,
    geometry,
    inertia,
    sensor,
    transmission,
)

__all__ = [
    "actuation",
    "contact",
    "counterbalance",
    "friction",
    "geometry",
    "inertia",
    "sensor",
    "transmission",
]
