import json
import re
from dataclasses import replace

import numpy as np
import pytest

from misstep import Column, Dataset, Outcome, Provenance, Trajectory, demonstrate, save_dataset
from misstep.blame import find_blame
from misstep.cli import main
from misstep.inspection import inspect, inspect_file
from misstep.inspection.filmstrip import PICTURES, draw_filmstrip, shown_steps
from misstep.inspection.page import render_inspection


@pytest.fixture(scope="module")
def shown(cartpole):
    return demonstrate(cartpole, "bang-bang", 3, 0)


@pytest.fixture(scope="module")
def file(shown, tmp_path_factory):
    path = tmp_path_factory.mktemp("inspect") / "D.h5"
    save_dataset(shown, path)
    return path


@pytest.fixture(scope="module")
def inspection(file):
    return inspect_file(file)


def test_columns_are_what_numpy_says_of_all_rows_together(shown, inspection):
    rows = {
        "observation": np.concatenate([t.observations for t in shown]),
        "action": np.concatenate([t.actions for t in shown]),
    }
    columns = [*shown.observation_columns, *shown.action_columns]
    assert [(c.name, c.unit) for c in inspection.columns] == [(c.name, c.unit) for c in columns]
    for kind, values in rows.items():
        found = [c for c in inspection.columns if c.kind == kind]
        for column, x in zip(found, values.T, strict=True):
            expected = (x.min(), x.max(), x.mean(), x.std())
            told = (column.minimum, column.maximum, column.mean, column.deviation)
            assert told == pytest.approx(expected, rel=1e-12, abs=1e-12)
            assert column.missing == 0


def test_episodes_are_what_was_recorded(shown, inspection):
    for number, (t, e) in enumerate(zip(shown, inspection.episodes, strict=True), start=1):
        assert (e.number, e.rows, e.outcome) == (number, t.n_steps + 1, t.outcome)
        assert (e.duration, e.rate) == (pytest.approx(t.duration), pytest.approx(1 / t.dt))
        assert e.failure_time == pytest.approx(t.failure_time)
        assert (e.system, e.seed) == (t.provenance.system, t.provenance.seed)
        assert (e.demonstrator, e.recorded) == (t.provenance.demonstrator, t.provenance.time)
        assert (e.missing, e.gaps, e.repeated, e.duplicate_of) == (0, (), 0, None)


def test_blame_is_that_of_the_data_set(shown, inspection):
    assert inspection.sentences[1] == f"episode 2: {find_blame(shown)[1].sentence}"


def test_json_has_the_names_that_are_fixed(file, tmp_path, capsys):
    result = tmp_path / "i.json"
    assert main(["inspect", str(file), "--json", str(result)]) == 0
    assert "recoverable until" in capsys.readouterr().out
    found = json.loads(result.read_text())
    assert len(found["columns"]) == 5
    for episode in found["episodes"]:
        assert episode["outcome"] == "failure"
        assert 0 < episode["point_of_no_return"] < episode["failure_time"]
        assert len(episode["blame"]) == episode["rows"] - 1
        assert all(0 <= b <= 1 for b in episode["blame"])
        assert episode["sentence"].startswith("recoverable until")


def attempt(x, u, name="x", unit="m", **fields):
    columns = (Column(name, unit),), (Column("u", "N"),)
    nowhere = Provenance("", {}, "", None, "")
    x, u = np.array(x, dtype=float)[:, None], np.array(u, dtype=float)[:, None]
    return Trajectory(x, u, 0.1, *columns, fields.pop("provenance", nowhere), **fields)


def test_odd_things_are_found(tmp_path):
    rng = np.random.default_rng(0)
    smooth = np.sin(0.1 * np.arange(61))
    stuck, jumped = smooth.copy(), smooth.copy()
    stuck[20:25] = stuck[20]
    jumped[30:] += 3.0
    u = np.clip(2 * rng.standard_normal(60), -1, 1)
    path = tmp_path / "odd.h5"
    save_dataset(
        Dataset([attempt(smooth, u), attempt(stuck, u), attempt(jumped, u), attempt(smooth, u)]),
        path,
    )
    found = inspect_file(path)
    plain, repeats, jumps, twin = found.episodes
    assert plain.oddities == []
    assert (repeats.repeated, repeats.longest_repeat) == (4, pytest.approx(0.4))
    assert [(j.column, round(j.time, 6)) for j in jumps.jumps] == [("x", 3.0)]
    assert twin.duplicate_of == 1
    assert twin.oddities == ["the same as episode 1"]
    assert found.columns[1].at_limit == pytest.approx(np.mean(np.abs(u) == 1))


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
def test_an_angle_that_goes_on_at_the_other_end_of_its_turn_does_not_jump(tmp_path, unit, turn):
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.uniform(0.005, 0.015, 400)) * turn
    wrapped = (angle + 0.5 * turn) % turn - 0.5 * turn
    u = rng.standard_normal(399)
    path = tmp_path / "turning.h5"
    save_dataset(Dataset([attempt(wrapped, u, "theta", unit)]), path)
    assert inspect_file(path).episodes[0].oddities == []


def test_infinite_values_count_as_missing(tmp_path):
    path = tmp_path / "inf.csv"
    rows = [f"{i / 10},{ {10: 'inf', 11: '-inf'}.get(i, i * i) },1" for i in range(20)]
    path.write_text("t,x,action:u\n" + "\n".join(rows) + "\n")
    found = inspect_file(path)
    assert found.episodes[0].missing == found.columns[0].missing == 2
    assert found.episodes[0].oddities == ["2 missing values"]
    assert found.columns[0].maximum == 19 * 19


def test_more_than_memory_should_hold_is_summarised_all_the_same(file, shown, monkeypatch):
    monkeypatch.setattr(inspect, "LARGEST_IN_MEMORY", 2 * shown[0].observations.nbytes)
    found = inspect_file(file)
    assert len(found.episodes) == len(shown)
    assert "bytes in memory" in found.reason
    assert found.dataset is None


def test_an_actuator_that_is_not_used_up_is_not_saturated(file, shown, inspection):
    force = inspection.columns[-1]
    assert np.concatenate([t.actions for t in shown]).max() == 10  # of 20 N
    assert force.at_limit == 0
    assert "cartpole" in inspection.limits.source


def test_missing_values_and_gaps_are_counted_and_placed(tmp_path):
    path = tmp_path / "holes.csv"
    path.write_text("time,x,u\n0,0,1\n0.1,1,0\n0.2,,1\n0.3,3,0\n0.8,8,1\n0.9,9,0\n")
    found = inspect_file(path)
    (episode,) = found.episodes
    assert episode.missing == 1
    assert episode.rate is None
    assert [(round(g.time, 6), round(g.seconds, 6)) for g in episode.gaps] == [(0.3, 0.5)]
    assert found.columns[0].missing == 1
    assert (found.columns[0].minimum, found.columns[0].maximum) == (0, 9)
    assert found.blames == ()
    assert found.reason.startswith("episode 1: ")
    assert "Nothing can be said" in render_inspection(found)


def test_the_page_holds_everything_itself(inspection, shown):
    page = render_inspection(inspection)
    assert page.count("data:image/png;base64,") == 2 * len(shown)
    assert not re.search(r'(?:src|href)="(?!data:image/png|#)', page)
    for blame in inspection.blames:
        assert blame.sentence in page


def test_texts_of_a_file_are_inert_on_the_page(tmp_path):
    evil = "<script>alert(1)</script>"
    origin = Provenance(evil, {}, evil, None, "", (f"note {evil}",))
    path = tmp_path / "evil.h5"
    rng = np.random.default_rng(0)
    save_dataset(Dataset([attempt(rng.random(30), rng.random(29), provenance=origin)]), path)
    page = render_inspection(inspect_file(path))
    assert evil not in page
    assert "&lt;script&gt;" in page


def test_what_was_inferred_is_told(shown, tmp_path, capsys):
    note = "actions: inferred by inverse dynamics of cartpole"
    source = replace(shown[0].provenance, notes=(note,))
    path = tmp_path / "inferred.h5"
    save_dataset(Dataset([replace(shown[0], provenance=source), *shown[1:]]), path)
    assert main(["inspect", str(path)]) == 0
    assert f"inferred or changed: {note}" in capsys.readouterr().out


def test_a_data_set_of_an_unknown_system_is_inspected(tmp_path):
    rng = np.random.default_rng(0)
    attempts = [attempt(rng.random(41), rng.random(40), outcome=Outcome.FAILURE) for _ in range(3)]
    path = tmp_path / "D.h5"
    save_dataset(Dataset(attempts), path)
    found = inspect_file(path)
    assert len(found.blames) == 3
    assert all("nobody said when" in b.sentence for b in found.blames)
    page = render_inspection(found)
    assert page.count("data:image/png;base64,") == 3  # signals, and no filmstrip


def test_one_short_attempt_is_inspected(tmp_path):
    path = tmp_path / "D.h5"
    save_dataset(Dataset([attempt([0, 9], [1.0], outcome=Outcome.FAILURE, failure_step=1)]), path)
    found = inspect_file(path)
    assert found.blames == ()
    assert "the action u is 1 N in all attempts" in found.reason
    save_dataset(
        Dataset([attempt([0, 1, 9], [1.0, 2.0], outcome=Outcome.FAILURE, failure_step=2)]), path
    )
    (blame,) = inspect_file(path).blames
    assert blame.point_of_no_return is None
    assert "at least 8" in blame.sentence


def test_the_filmstrip_shows_the_point_of_no_return_and_the_failure(shown, inspection):
    for t, blame in zip(shown, inspection.blames, strict=True):
        steps = shown_steps(t, blame)
        assert len(steps) == PICTURES
        assert np.all(np.diff(steps) >= 0)
        assert round(blame.point_of_no_return / t.dt) in steps
        assert steps[-1] == t.failure_step
    whole = replace(inspection.blames[0], point_of_no_return=None)
    assert shown_steps(shown[0], whole)[[0, -1]].tolist() == [0, shown[0].n_steps]


def test_a_system_without_a_drawing_has_no_filmstrip(shown, inspection, refused):
    other = replace(shown[0].provenance, system="somewhere")
    with refused("no drawing of the system"):
        draw_filmstrip(replace(shown[0], provenance=other), inspection.blames[0])
    renamed = (Column("position", "m"), *shown[0].observation_columns[1:])
    with refused("a picture of cartpole needs the column 'x'"):
        draw_filmstrip(replace(shown[0], observation_columns=renamed), inspection.blames[0])


def test_a_file_that_is_not_there_is_told_in_one_line(tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "none.h5")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_inspecting_twice_says_the_same(file, tmp_path, capsys):
    for name in ("a.json", "b.json"):
        assert main(["inspect", str(file), "--json", str(tmp_path / name)]) == 0
    first, second = (json.loads((tmp_path / n).read_text()) for n in ("a.json", "b.json"))
    assert first["episodes"] == second["episodes"]
