"""Systems by what a file says of them: a recording, a run or a study may be a stranger's.

A name and parameters out of a file build a simulation and nothing else. They open no file and no
connection, and send no token: what does so is only built of what the user says.
"""

from collections.abc import Mapping
from typing import Any

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue, build_parameters
from misstep.systems.gymnasium_adapter import PREFIX, GymSystem
from misstep.systems.judged import JUDGE_PARAMETERS
from misstep.systems.system import System


def recorded_system(
    name: str,
    recorded: Mapping[str, Any],
    given: Mapping[str, ParameterValue] | None = None,
    *,
    typed: bool = False,
) -> System:
    """Build the system that a file names.

    Parameters
    ----------
    name : str
    recorded : mapping
        Its parameters as the file states them.
    given : mapping, optional
        Parameters that the user gives, in place of recorded ones.
    typed : bool
        Whether the user names this system too. Then it is built, whichever it is; of recorded
        parameters numbers, truth values and the formulas that judge are taken, and no other text,
        because it may be a path or an address.

    Raises
    ------
    MisstepError
        As `make_system`; if the user has to name the system (`System.typed_only`), or to repeat
        a text that it was recorded with.
    """
    from misstep.systems import make_system

    kind = system_kind(name)
    given = dict(given or {})
    judges = {row.name for row in JUDGE_PARAMETERS}
    if kind.typed_only is not None:
        # Nothing that its constructor would take beside them, such as render_mode.
        own = {key: recorded[key] for key in recorded if key not in judges}
        build_parameters(kind.parameters_type, name, own)
        words = {key: recorded[key] for key in recorded if key not in kind.typed_only}
        return make_system(name, **{**words, **given})
    if not typed:
        raise MisstepError(
            f"{name} is not built from what a file says, since it may open files or connections"
        )
    words = {k: v for k, v in recorded.items() if k in judges or isinstance(v, bool | int | float)}
    system = make_system(name, **{**words, **given})
    lacking = [k for k in differences(system, recorded) if k not in words and k not in given]
    if lacking:
        system.close()
        listed = ", ".join(f"{key}={recorded[key]!r}" for key in lacking)
        raise MisstepError(
            f"{name} was recorded with {listed}: a text that could be a path or an address is not "
            "taken from a file; give it, or what is to be in its place"
        )
    return system


def system_kind(name: str) -> type[System]:
    """Return the class of a system; raise MisstepError where there is none of that name."""
    from misstep.systems import SYSTEMS

    return GymSystem if name.startswith(PREFIX) else SYSTEMS[name]


def differences(system: System, recorded: Mapping[str, Any]) -> list[str]:
    """Return the names of recorded parameters that `system` has not, or with other values.

    Not those that only a user may give: a robot may have moved to another address.
    """
    moved = system_kind(system.system_id).typed_only or frozenset()
    own = system.parameters
    return sorted(k for k in recorded if k not in moved and own.get(k) != recorded[k])
