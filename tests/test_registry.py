"""Names for things that can be added from outside."""

from collections.abc import Mapping

import pytest

from misstep import FORMATS, LEARNERS, load_dataset, save_dataset
from misstep.errors import MisstepError
from misstep.formats import format_of
from misstep.formats.format import Format
from misstep.registry import Registry


def test_a_registry_is_a_mapping():
    things = Registry("thing", "misstep.things")
    things.register("one")(1)
    assert isinstance(things, Mapping)
    assert (things["one"], things.get("one"), list(things), len(things)) == (1, 1, ["one"], 1)
    assert things.get("two") is None
    assert things.get("two", 2) == 2
    assert "two" not in things
    assert dict(things) == {"one": 1}
    assert things.loaded() == ({"one": 1}, {})


def test_an_unknown_name_is_told_in_one_line_and_is_a_key_error():
    for kind in (MisstepError, KeyError):
        with pytest.raises(kind) as caught:
            LEARNERS["fal"]
        assert str(caught.value).startswith("no learner named 'fal'; there are: balanced-mean, ")


def test_a_name_is_taken_once():
    things = Registry("thing", "misstep.things")
    things.register("one")(1)
    with pytest.raises(MisstepError, match="there is a thing named 'one' already"):
        things.register("one")(2)


def test_a_format_is_known_from_its_registration_on(tmp_path, monkeypatch):
    path = tmp_path / "a.late"
    with pytest.raises(MisstepError, match=r"no format goes by the suffix '\.late'"):
        format_of(path)
    hdf5 = FORMATS["hdf5"]
    monkeypatch.setattr(FORMATS, "_own", dict(FORMATS._own))
    FORMATS.register("late")(Format("late", (".late",), hdf5.read, hdf5.write))
    dataset = load_dataset_of_one()
    save_dataset(dataset, path)
    assert load_dataset(path) == dataset


def load_dataset_of_one():
    from misstep import demonstrate, make_system

    return demonstrate(make_system("cartpole"), "weak", n=1, time="2026-01-01")
