"""What third parties write: other ways to declare, and NumPy's numbers."""

import sys
import types
from dataclasses import dataclass

import numpy as np
import pytest

from misstep.errors import MisstepError
from misstep.learners import Mean
from misstep.parameters import build_parameters, check_parameters, parameter, parameter_table

THIRD_PARTY = """
from __future__ import annotations
from dataclasses import dataclass
from misstep.parameters import check_parameters, parameter

@dataclass(frozen=True)
class Settings:
    gain: float = parameter(2.0, "N", "how hard", above=0)
    count: int = parameter(3, "", "how many", at_least=1)
    loud: bool = parameter(False, "", "whether")
    name: str = parameter("a", "", "called")

    def __post_init__(self):
        check_parameters(self, "settings")
"""


@pytest.fixture
def settings(monkeypatch):
    module = types.ModuleType("third_party_settings")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(THIRD_PARTY, module.__dict__)  # noqa: S102
    return module.Settings


def test_annotations_may_be_texts(settings):
    made = build_parameters(settings, "settings", {"gain": 3, "count": 4})
    assert (made.gain, type(made.gain), made.count) == (3.0, float, 4)
    with pytest.raises(MisstepError, match="gain is 'x' but must be a number in N: how hard"):
        settings(gain="x")
    with pytest.raises(MisstepError, match="gain is 0 N but must be greater than 0 N"):
        settings(gain=0)


def test_numpys_numbers_are_numbers(settings):
    made = settings(gain=np.float32(2.5), count=np.int64(7), loud=np.bool_(True), name=np.str_("b"))
    assert (made.gain, made.count, made.loud, made.name) == (2.5, 7, True, "b")
    assert [type(v) for v in (made.gain, made.count, made.loud, made.name)] == [
        float,
        int,
        bool,
        str,
    ]
    assert Mean(n_components=np.int64(3)).n_components == 3
    with pytest.raises(MisstepError, match=r"count is .*2.5.* but must be a whole number"):
        settings(count=np.float64(2.5))
    with pytest.raises(MisstepError, match=r"gain is .*nan.* but must be a finite number"):
        settings(gain=np.nan)


def test_what_is_no_parameter_is_told_in_one_line():
    @dataclass(frozen=True)
    class Plain:
        gain: float = 1.0

        def __post_init__(self):
            check_parameters(self, "plain")

    @dataclass(frozen=True)
    class Optional:
        gain: float | None = parameter(1.0, "", "how hard")

        def __post_init__(self):
            check_parameters(self, "optional")

    class Nothing:
        pass

    with pytest.raises(MisstepError, match=r"Plain.gain says no unit and meaning: declare it as"):
        Plain()
    with pytest.raises(MisstepError, match=r"gain is declared as float | None: a parameter is a"):
        Optional()
    with pytest.raises(MisstepError, match="Nothing is no dataclass"):
        parameter_table(Nothing)
