"""Physics and demonstrators for an experiment whose paper states neither.

The paper gives no mass, length, damping, gain or noise. Both calibrations here were fitted to
table I alone, the costs of the demonstrations; nothing was tuned on the explorations. They are not
unique, which is why there are two: what holds under both is less likely to be an accident.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from misstep.parameters import ParameterValue


@dataclass(frozen=True)
class Calibration:
    """One choice of cart-pole and demonstrator."""

    name: str
    how: str
    """How it was chosen, a sentence for the report."""
    system: Mapping[str, ParameterValue]
    demonstrator: Mapping[str, ParameterValue]
    """Parameters of the demonstrator ``noisy``."""


FIRST = Calibration(
    name="A",
    how=(
        "Found by hand on a prototype so that the demonstrations' costs fall where table I's do, "
        "then repeated on MuJoCo unchanged."
    ),
    system={
        "cart_mass": 1.16,
        "pole_mass": 0.244,
        "half_length": 0.594,
        "hinge_damping": 0.0915,
        "cart_damping": 8.84,
        "rail": 3.0,
        # The paper names no limit; this one is never reached.
        "force_limit": 1000.0,
        "control_rate": 20.0,
        "start_spread": 0.01,
        "stop_at_fall": False,
    },
    demonstrator={"gain": 76.0, "noise": 0.69, "hold": 0.05},
)

SECOND = Calibration(
    name="B",
    how=(
        "The best of 2,400 candidates of a random search over physics and demonstrator "
        "(studies/calibrate_paper.py), at another control rate and with a force limit."
    ),
    system={
        "cart_mass": 0.93,
        "pole_mass": 1.16,
        "half_length": 0.293,
        "hinge_damping": 0.134,
        "cart_damping": 1.2,
        "rail": 7.18,
        "force_limit": 100.0,
        "control_rate": 50.0,
        "start_spread": 0.074,
        "stop_at_fall": False,
    },
    demonstrator={"gain": 40.0, "noise": 1.5, "hold": 0.229},
)

CALIBRATIONS = {calibration.name: calibration for calibration in (FIRST, SECOND)}
