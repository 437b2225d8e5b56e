"""Units in which recordings come."""

import math

from scipy.constants import g

from fbse_drake.errors import InputError

# Unit -> what it is in SI, and how much of it.
_UNITS: dict[str, tuple[str, float]] = {
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180),
    "rev": ("rad", 2 * math.pi),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180),
    "rev/s": ("rad/s", 2 * math.pi),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "rad/s^2": ("rad/s^2", 1.0),
    "deg/s^2": ("rad/s^2", math.pi / 180),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "m/s": ("m/s", 1.0),
    "mm/s": ("m/s", 1e-3),
    "m/s^2": ("m/s^2", 1.0),
    "g": ("m/s^2", g),
    "Nm": ("Nm", 1.0),
    "mNm": ("Nm", 1e-3),
    "kNm": ("Nm", 1e3),
    "N": ("N", 1.0),
    "kN": ("N", 1e3),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "degC": ("degC", 1.0),
    "1": ("1", 1.0),
    "%": ("1", 1e-2),
}
# What a channel of a revolute joint is for a prismatic one.
_PRISMATIC = {"rad": "m", "rad/s": "m/s", "rad/s^2": "m/s^2", "Nm": "N"}


def si_factor(unit: str, si: str, *, joint: bool = False) -> float:
    """How many `si` one `unit` is.

    Args:
        si: the SI unit that is wanted.
        joint: of a joint, which may be prismatic: metres and newtons will do as well.

    Raises:
        InputError: an unknown unit, or one of something else.
    """
    wanted = (si, _PRISMATIC.get(si)) if joint else (si,)
    kind, factor = _UNITS.get(unit, ("", 0.0))
    if kind not in wanted:
        allowed = ", ".join(name for name, (other, _) in _UNITS.items() if other in wanted)
        if not allowed:
            raise InputError(
                f"unit: none can be given for {si}; gains make SI units of the columns"
            )
        hint = f"; what is measured in {unit} needs a gain that makes {si} of it" if kind else ""
        raise InputError(f"unit: expected one of {allowed}, found {unit}{hint}")
    return factor
