"""Physical effects; importing the package fills the library."""

from fbse_drake.effects import actuation, contact, friction, inertia, sensor, transmission

__all__ = ["actuation", "contact", "friction", "inertia", "sensor", "transmission"]
