import json
import math
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from peak_memory import needs_status, run_with_peak

import misstep
from misstep import Column, Dataset, Outcome
from misstep.cli import main
from misstep.formats import load_dataset
from misstep.formats.format import Block, Episode, Header, joined
from misstep.recordings.mapping import (
    ColumnMapping,
    MappedColumn,
    load_mapping,
    parse_columns,
    save_mapping,
)
from misstep.recordings.pipeline import Plan
from misstep.trajectory import Provenance

STATE = "x:m,x_dot:m/s,theta:rad,theta_dot:rad/s"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def convert(here, capsys):
    def run(*words):
        capsys.readouterr()
        code = main(["convert", *map(str, words)])
        return code, *capsys.readouterr()

    return run


def dataset(n=2):
    return misstep.demonstrate(misstep.make_system("cartpole"), by="weak", n=n, seed=0)


# Columns


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("x", [MappedColumn("x")]),
        (
            "x=cart:cm , theta=2:deg:-1",
            [MappedColumn("x", "cart", "cm"), MappedColumn("theta", "2", "deg", -1.0)],
        ),
        ("theta=2:deg:-1:180", [MappedColumn("theta", "2", "deg", -1.0, 180.0)]),
        ("x:m", [MappedColumn("x", "", "m")]),
        ("x::0.5", [MappedColumn("x", "", "", 0.5)]),
        ('x="a, b=c:d":m,y', [MappedColumn("x", "a, b=c:d", "m"), MappedColumn("y")]),
        ("q=/joints.position[0]:rad", [MappedColumn("q", "/joints.position[0]", "rad")]),
    ],
)
def test_columns_are_read_as_they_are_written(text, columns):
    assert list(parse_columns("--columns", text)) == columns


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "write name=source:unit:factor:offset"),
        ("x,,y", "write name=source"),
        ("x=a=b", "write name=source"),
        ("=a", "write name=source"),
        ("x:m:1:2:3", "write name=source"),
        ('x="a', "write name=source"),
        ("x:m:minus", "'minus' is no number"),
        ("x:m:0", "factor is 0, but must be finite and not zero"),
        ("x:m:nan", "factor is nan"),
        ("x:m:1:inf", "offset is inf"),
    ],
)
def test_other_texts_are_refused(refused, text, reason):
    with refused(reason):
        parse_columns("--columns", text)


numbers = st.floats(allow_nan=False, allow_infinity=False)
words = st.text(st.characters(exclude_categories=("C", "Z")), max_size=6)
mapped = st.builds(MappedColumn, words.filter(bool), words, words, numbers.filter(bool), numbers)
unique = st.lists(mapped, max_size=3, unique_by=lambda c: c.name).map(tuple)
rates = st.none() | st.floats(1e-3, 1e6)
named = st.none() | st.booleans()


@given(st.builds(ColumnMapping, unique, unique, words, words, rates, named))
def test_a_mapping_comes_back_from_its_file(tmp_path_factory, mapping):
    path = tmp_path_factory.getbasetemp() / "mapping.toml"
    save_mapping(mapping, path)
    assert load_mapping(path) == mapping


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("rate = ", "no TOML"),
        ("rate = -1", "the rate is -1"),
        ("rate = 'fast'", "the rate is 'fast'"),
        ("rate = true", "the rate is True"),
        ("speed = 1", "a mapping has no 'speed'; it has: observations, actions, time"),
        ("time = 3", "time is 3: name a column"),
        ("observations = 3", "listed as"),
        ("[[observations]]\nsource = 'x'", "a column has no name"),
        ("[[observations]]\nname = 'x'\nsize = 2", "a column has no 'size'"),
        ("[[observations]]\nname = 'x'\nfactor = '2'", "factor is '2', not a number"),
        ("[[observations]]\nname = 'x'\n[[observations]]\nname = 'x'", "'x' is mapped twice"),
        ("named = 'yes'", "named is 'yes'"),
    ],
)
def test_bad_mappings_are_refused(tmp_path, refused, text, reason):
    path = tmp_path / "m.toml"
    with refused("cannot read .*m.toml: No such file"):
        load_mapping(path)
    path.write_text(text)
    with refused(f"m.toml: .*{reason}"):
        load_mapping(path)


def test_values_are_brought_to_si_units_and_it_is_noted():
    header = Header(
        0.1,
        (Column("a", ""), Column("b", "cm"), Column("c", "s")),
        (),
        Provenance("", {}, "", None, ""),
    )
    table = np.array([[90.0, 150.0, 1.0], [180.0, 250.0, 2.0]])
    block = Block(table.copy(), np.empty((0, 0)))
    mapping = ColumnMapping(
        parse_columns("--columns", "theta=a:deg:-1:90,x=b"), parse_columns("--actions", "u=0:N:2")
    )
    out = mapping.apply(Episode(header, iter([block])))
    made = joined(out)
    assert out.header.observation_columns == (Column("theta", "rad"), Column("x", "m"))
    assert out.header.action_columns == (Column("u", "N"),)
    np.testing.assert_allclose(made.observations, [[0, 1.5], [-math.pi / 2, 2.5]])
    assert made.actions.tolist() == [[180.0]]
    assert out.header.provenance.notes == (
        "theta: deg to rad, times -1, plus 90 deg",
        "x: cm to m",
        "u: times 2",
        "columns left out: c",
    )


def test_a_missing_column_lists_those_there(refused):
    header = Header(0.1, (Column("a", ""),), (Column("u", "N"),), Provenance("", {}, "", None, ""))
    for mapping, reason in (
        (ColumnMapping(parse_columns("", "x=z")), "no column 'z' for 'x'; there are: a"),
        (ColumnMapping((), parse_columns("", "u=v")), "no column 'v' for 'u'; there are: u"),
    ):
        with refused(reason):
            mapping.apply(Episode(header, iter([])))


# The command


def test_there_and_back_again_nothing_changes(convert, here):
    original = dataset()
    misstep.save_dataset(original, "D.h5")
    for step, (source, target) in enumerate((("D.h5", "D.csv"), ("D.csv", "D.parquet"))):
        code, out, _ = convert(source, target)
        assert code == 0
        assert f"2 episodes, {sum(t.n_steps for t in original)} steps at 50 Hz in {target}" in out
        assert "(2 failure)" in out, step
    assert convert("D.parquet", "E.h5")[0] == 0
    assert (here / "E.h5").read_bytes() == (here / "D.h5").read_bytes()


def test_several_files_become_one(convert):
    first, second = dataset(n=2)
    misstep.save_dataset(Dataset([first]), "a.h5")
    misstep.save_dataset(Dataset([second]), "b.csv")
    assert convert("a.h5", "b.csv", "c.h5")[0] == 0
    assert load_dataset("c.h5") == Dataset([first, second])


def swing(steps=4000):
    """Return a motion at 1 kHz, in which the pole turns over, and its columns."""
    t = np.arange(steps + 1) * 1e-3
    theta = 2.5 + 0.8 * t
    x = 0.3 * np.sin(2 * t)
    wrapped = (theta + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([x, 0.6 * np.cos(2 * t), wrapped, np.full_like(t, 0.8)])


def test_a_headerless_recording_without_actions_becomes_a_dataset(convert, here):
    np.savetxt("log.csv", swing(), delimiter=",", fmt="%.12g")
    words = ("--rate", 1000, "--to-rate", 50, "--infer-actions", "inverse-dynamics")
    system = ("--system", "cartpole", "--set", "cart_mass=10", "--set", "pole_mass=5")
    judges = ("--failure", "abs(theta) > 3", "--by", "person")
    code, out, err = convert(
        "log.csv", "D.h5", "--columns", STATE, *words, *system, *judges,
        "--save-mapping", "m.toml", "--json", "r.json",
    )  # fmt: skip
    assert (code, err) == (0, "")
    (trajectory,) = load_dataset("D.h5")
    assert trajectory.dt == 0.02
    assert trajectory.n_steps == 200
    assert trajectory.action_columns == misstep.make_system("cartpole").action_columns
    np.testing.assert_allclose(trajectory.column("x"), swing()[::20, 0], atol=1e-4)
    assert trajectory.outcome is Outcome.FAILURE
    over = np.abs(trajectory.column("theta")) > 3
    assert trajectory.failure_step == int(np.argmax(over))
    origin = trajectory.provenance
    assert (origin.system, origin.demonstrator) == ("cartpole", "person")
    assert origin.parameters["cart_mass"] == 10
    inferred = [note for note in origin.notes if note.startswith("actions: ")]
    assert "inferred by inverse dynamics" in inferred[0]
    for note in origin.notes:
        assert f"noted: {note}" in out
    assert any(note.startswith("rate: from 1000 Hz to 50 Hz") for note in origin.notes)
    result = json.loads((here / "r.json").read_text())
    assert (result["episodes"], result["steps"], result["rates"]) == (1, 200, [50.0])
    assert result["outcomes"] == ["failure"]
    assert set(result["notes"]) == set(origin.notes)
    # The mapping that was kept does the same.
    code, *_ = convert("log.csv", "E.h5", "--mapping", "m.toml", *words[2:], *system, *judges)
    assert code == 0
    assert load_dataset("E.h5") == load_dataset("D.h5")


def test_velocities_can_stand_for_actions(convert):
    np.savetxt("log.csv", swing(), delimiter=",", fmt="%.12g")
    code, out, _ = convert(
        "log.csv", "D.h5", "--columns", STATE, "--rate", 1000, "--to-rate", 50,
        "--infer-actions", "velocities:theta",
    )  # fmt: skip
    assert code == 0
    (trajectory,) = load_dataset("D.h5")
    assert trajectory.action_columns == (Column("theta_dot", "rad/s"),)
    np.testing.assert_allclose(trajectory.actions, 0.8, atol=1e-6)
    assert "actions: not recorded, the velocities of theta" in out


def test_times_that_are_uneven_are_brought_to_one_clock(convert):
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.008, 0.012, 600))
    np.savetxt(
        "log.csv", np.column_stack([times, times**2, times]), delimiter=",",
        header="t,x,u", comments="",
    )  # fmt: skip
    code, _, err = convert("log.csv", "D.h5", "--actions", "u:N")
    assert code == 2
    assert "uneven times, which this format cannot hold: bring it to one clock" in err
    code, out, _ = convert("log.csv", "D.h5", "--actions", "u:N", "--to-rate", 20)
    assert code == 0
    assert "interpolated to a clock" in out
    assert convert("log.csv", "E.h5", "--actions", "u:N", "--time", "t", "--rate", 50)[0] == 0
    assert load_dataset("E.h5").dt == 0.02
    # A rate without a column of times stands over the times.
    code, out, _ = convert("log.csv", "F.h5", "--actions", "u:N", "--rate", 50)
    assert "columns left out: t" in out
    assert load_dataset("F.h5")[0].n_steps == 599
    (trajectory,) = load_dataset("D.h5")
    at = times[0] + np.arange(trajectory.n_steps + 1) * 0.05
    np.testing.assert_allclose(trajectory.column("x")[12:-12], at[12:-12] ** 2, atol=2e-3)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("D.h5",), "misstep convert IN... OUT"),
        (("D.h5", "a.xls"), "a.xls: no format goes by the suffix '.xls'"),
        (("none.csv", "a.h5"), "cannot read none.csv: there is no such file"),
        (("log.csv", "a.h5"), "give --rate in Hz"),
        (("log.csv", "a.h5", "--rate", "100"), "no actions, which this format has to have"),
        (("log.csv", "a.h5", "--rate", "0"), "the rate is 0"),
        (("D.h5", "a.h5", "--to-rate", "-5"), "--to-rate is -5"),
        (("D.h5", "a.h5", "--to-rate", "0.001"), "a.h5: D.h5: an episode is shorter than one step"),
        (("D.h5", "a.h5", "--columns", "y"), "no column 'y' for 'y'; there are: x"),
        (("D.h5", "a.h5", "--failure", "y > 1"), "--failure, character 1: no column 'y'"),
        (("D.h5", "a.h5", "--set", "length=2"), "name it with --system"),
        (("D.h5", "a.h5", "--system", "cart"), "no system named 'cart'"),
        (("D.h5", "a.h5", "--system", "cartpole", "--set", "mass=2"), "no parameter 'mass'"),
        (("D.h5", "a.h5", "--infer-actions", "guess"), "there are inverse-dynamics and velocities"),
        (("D.h5", "a.h5", "--infer-actions", "inverse-dynamics"), "name it with --system"),
        (("D.h5", "a.h5", "--infer-actions", "velocities:y"), "no observation column 'y'"),
        (
            ("D.h5", "a.h5", "--infer-actions", "inverse-dynamics:x", "--system", "cartpole"),
            "only velocities are of some columns",
        ),
        (("D.h5", "a.h5", "--angles", "flat"), "recorded, wrapped and unwrapped"),
        (("D.h5", "a.h5", "--format", "excel"), "no format named 'excel'"),
        (("D.h5", "a.h5", "--mapping", "none.toml"), "cannot read none.toml"),
        (("D.h5", "nowhere/a.h5"), "nowhere"),
        (("D.h5", "D.h5"), "D.h5 exists already: choose another name, or add --force"),
        (("bad.csv", "D.h5", "--force", "--rate", "9"), "line 70002, column 1"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_and_nothing_is_left(convert, here, words, reason):
    misstep.save_dataset(dataset(n=1), "D.h5")
    before = (here / "D.h5").read_bytes()
    (here / "log.csv").write_text("1,2\n3,4\n5,6\n")
    (here / "bad.csv").write_text("x,action:u\n" + "1,2\n" * 70_000 + "1,oops\n")
    code, _, err = convert(*words)
    assert code == 2
    assert reason in err
    assert err.count("\n") == 1
    assert sorted(os.listdir(here)) == ["D.h5", "bad.csv", "log.csv"]
    assert (here / "D.h5").read_bytes() == before


def test_what_would_be_lost_is_listed_and_needs_leave(convert, here):
    from misstep.formats import FORMATS
    from misstep.formats.format import Format

    misstep.save_dataset(dataset(n=2), "D.h5")
    narrow = Format(
        "a narrow format; for this test",
        (),
        None,
        FORMATS["csv"].write,
        losses=lambda header: [f"the seed {header.provenance.seed}"],
    )
    FORMATS.register("narrow")(narrow)
    try:
        code, _, err = convert("D.h5", "a.txt", "--format", "narrow")
        assert code == 2
        assert "a narrow format cannot hold of episode_0: the seed" in err
        assert "--allow-loss" in err
        assert os.listdir(here) == ["D.h5"]
        code, out, _ = convert("D.h5", "a.txt", "--format", "narrow", "--allow-loss")
        assert code == 0
        assert out.count("lost: the seed") == 2
        code, _, err = convert("a.txt", "b.h5", "--from-format", "narrow")
        assert "only written, not read" in err
        assert convert("a.txt", "b.h5", "--from-format", "csv")[0] == 0
    finally:
        del FORMATS._own["narrow"]
    assert load_dataset("b.h5") == load_dataset("D.h5")


def test_a_plan_that_does_not_fit_is_refused(refused):
    with refused("parameters belong to a system"):
        Plan(parameters={"a": 1})
    with refused("goes by the equations of a system"):
        Plan(infer_actions="inverse-dynamics")


def test_a_value_that_overflows_is_refused(convert, here):
    (here / "log.csv").write_text("x,action:u\n1e300,1\n2e300,1\n3e300,\n")
    code, _, err = convert("log.csv", "a.h5", "--rate", 10, "--columns", "x::1e20")
    assert code == 2
    assert "too large to be finite" in err
    assert os.listdir(here) == ["log.csv"]


def test_a_short_recording_at_another_rate_is_the_same_in_every_format(convert):
    short = dataset(n=1)[0].cut(9)
    misstep.save_dataset(Dataset([short]), "D.h5")
    for name in ("E.h5", "E.csv", "E.parquet"):
        assert convert("D.h5", name, "--to-rate", 10)[0] == 0
        (found,) = load_dataset(name)
        assert found.n_steps == 1
        assert found.actions[0] == pytest.approx(short.actions[:5].mean(axis=0))


def test_what_is_found_wrong_on_the_way_is_told_with_its_file(convert, here):
    times = np.arange(40_000) * 0.01
    for name, gap in (("one.csv", 0.0), ("two.csv", 3.0)):
        rows = np.stack([times + gap * (times > 300), times, times], 1)
        np.savetxt(here / name, rows, "%.4f", ",", header="t,x,action:u", comments="")
    code, _, err = convert("one.csv", "two.csv", "out.h5", "--to-rate", 50)
    assert code == 2
    assert "two.csv: line 30003: 3.01 s have passed since the row before" in err
    (here / "two.csv").write_text("t,x,action:u\n0,0,0\n1,1,oops\n")
    code, _, err = convert("one.csv", "two.csv", "out.h5", "--to-rate", 50)
    assert code == 2
    assert err.count("two.csv") == 1


def test_a_recording_too_short_for_the_equations_says_so(convert):
    short = dataset(n=1)[0].cut(5)
    misstep.save_dataset(Dataset([short]), "D.h5")
    code, out, _ = convert("D.h5", "E.h5", "--system", "cartpole")
    assert code == 0
    assert "the equations were not checked: every episode is shorter than 8 rows" in out


def test_an_outcome_that_was_recorded_moves_with_the_rate(convert):
    (original,) = dataset(n=1)
    misstep.save_dataset(Dataset([original]), "D.h5")
    assert convert("D.h5", "E.h5", "--to-rate", 10)[0] == 0
    (made,) = load_dataset("E.h5")
    assert made.outcome is original.outcome
    assert abs(made.failure_time - original.failure_time) <= 0.1


@needs_status
def test_a_long_recording_needs_little_memory(here):
    rng = np.random.default_rng(0)
    block = "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in rng.normal(size=(10_000, 3)).tolist())
    with open("long.csv", "w") as file:
        for _ in range(60):
            file.write(block)
    code = "from misstep.cli import main\nassert main(sys.argv[1:]) == 0\nprint(peak())\n"
    words = ["convert", "long.csv", "D.h5", "--actions", "u=2", "--rate", "1000"]
    *_, peak = run_with_peak(code, *words)
    assert int(peak) < 150_000  # KiB; the numbers alone are 14 MB, the text 35
    assert load_dataset("D.h5")[0].n_steps == 599_999
