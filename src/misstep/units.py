"""Units that people write, and the ones without prefixes that they are brought to."""

import math

_DEGREE = math.pi / 180.0

UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "km": ("m", 1e3),
    "rad": ("rad", 1.0),
    "deg": ("rad", _DEGREE),
    "°": ("rad", _DEGREE),
    "rev": ("rad", 2.0 * math.pi),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "kg": ("kg", 1.0),
    "g": ("kg", 1e-3),
    "m/s": ("m/s", 1.0),
    "cm/s": ("m/s", 1e-2),
    "mm/s": ("m/s", 1e-3),
    "km/h": ("m/s", 1.0 / 3.6),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", _DEGREE),
    "°/s": ("rad/s", _DEGREE),
    "rpm": ("rad/s", math.pi / 30.0),
}
"""Unit by unit: the one it is brought to, and how many of those it is."""

TURNS = {"rad": 2.0 * math.pi, "deg": 360.0}
"""A full turn, in each unit in which columns are taken for angles that may wrap."""
