"""A stranger's folder of failed attempts, through the command line alone, to a learned swing-up."""

import json
import math

import numpy as np
import pytest
from attempts import HEAVY, attempt

from misstep import FORMATS, Outcome, load_dataset
from misstep.cli import main

ATTEMPTS, SECONDS = 5, 4.0
COLUMNS = "x:m,x_dot:m/s,theta:rad,theta_dot:rad/s"
SYSTEM = ("--system", "cartpole-swingup", *(f"--set={k}={v:g}" for k, v in HEAVY.items()))
INFERRED = ("--to-rate", "50", "--infer-actions", "inverse-dynamics", *SYSTEM)
TURN = 2 * math.pi


@pytest.fixture(scope="module")
def attempts():
    """Observations (T + 1, 4) and forces (T,) of each attempt, at 1 kHz."""
    return [attempt(100 + i, SECONDS) for i in range(ATTEMPTS)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def misstep(here, capsys):
    """Run a command; return its exit code and what it prints."""

    def run(*words):
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return code, out + err

    return run


def written(tables, name="attempt"):
    """Write one CSV without a header for each table; return their names."""
    files = [f"{name}{i}.csv" for i in range(len(tables))]
    for file, table in zip(files, tables, strict=True):
        np.savetxt(file, table, delimiter=",", fmt="%.6f")
    return files


def rows(attempts):
    return [observations for observations, _ in attempts]


def test_from_a_folder_of_failures_to_a_swing_up(attempts, here, misstep):
    files = written(rows(attempts))
    code, out = misstep(
        "convert", *files, "D.h5", "--columns", COLUMNS, "--rate", 1000, *INFERRED,
        "--success", "abs(theta) < 12deg", "--hold", 1, "--by", "person", "--json", "c.json",
    )  # fmt: skip
    assert code == 0
    assert f"the equation of theta holds in all {ATTEMPTS} episodes" in out
    assert "warning" not in out
    assert "inferred by inverse dynamics" in out
    dataset = load_dataset("D.h5")
    for recorded, (_, forces) in zip(dataset, attempts, strict=True):
        assert recorded.outcome is Outcome.FAILURE
        assert any("not recorded, inferred" in note for note in recorded.provenance.notes)
        held = forces.reshape(-1, 20).mean(axis=1)
        np.testing.assert_allclose(recorded.actions[:, 0], held, atol=2.0)
    checks = json.loads((here / "c.json").read_text())["equations"]
    assert [check["episode"] for check in checks] == list(range(1, ATTEMPTS + 1))
    assert all(check["holds"] and check["r_squared"] > 0.9999 for check in checks)

    code, out = misstep("inspect", "D.h5", "--json", "i.json", "--out", "i.html")
    assert code == 0
    assert f"the equation of theta holds in all {ATTEMPTS} episodes" in out
    found = json.loads((here / "i.json").read_text())
    assert [episode["outcome"] for episode in found["episodes"]] == ["failure"] * ATTEMPTS
    assert len(found["equations"]) == ATTEMPTS
    assert "Does it obey the equations?" in (here / "i.html").read_text()

    code, out = misstep(
        "learn", "cartpole-swingup", "--from", "D.h5", "--max-trials", 4, "--json", "l.json"
    )
    assert code == 0, out
    learned = json.loads((here / "l.json").read_text())
    assert learned["learner"] == "dynamics"
    assert 1 <= learned["trials_to_success"] <= 4


def hanging(table):
    """Return the table with the angle counted from where the pole hangs."""
    other = table.copy()
    other[:, 2] = other[:, 2] % TURN - math.pi
    return other


def degrees(table):
    return table * [1, 1, 180 / math.pi, 180 / math.pi]


def unwrapped(table):
    other = table.copy()
    other[:, 2] = np.unwrap(other[:, 2])
    return other


def timed(table):
    return np.column_stack([12.5 + 1e-3 * np.arange(len(table)), table])


DECLARED = {
    "unwrapped": (unwrapped, ("--columns", COLUMNS, "--rate", 1000)),
    "hanging": (
        hanging,
        ("--columns", "x:m,x_dot:m/s,theta:rad:1:pi,theta_dot:rad/s", "--rate", 1000),
    ),
    "degrees": (
        degrees,
        ("--columns", "x:m,x_dot:m/s,theta:deg,theta_dot:deg/s", "--rate", 1000),
    ),
    "times": (timed, ("--columns", COLUMNS, "--time", 0)),
    "500 Hz": (lambda table: table[::2], ("--columns", COLUMNS, "--rate", 500)),
    "no velocities": (
        lambda table: table[:, [0, 2]],
        ("--columns", "x:m,theta:rad", "--rate", 1000),
    ),
}


@pytest.mark.parametrize("kind", DECLARED)
def test_other_conventions_are_declared_and_give_the_same(attempts, misstep, kind):
    change, options = DECLARED[kind]
    plain = written(rows(attempts)[:2])
    assert (
        misstep("convert", *plain, "D.h5", "--columns", COLUMNS, "--rate", 1000, *INFERRED)[0] == 0
    )
    other = written([change(table) for table in rows(attempts)[:2]], "other")
    code, out = misstep("convert", *other, "E.h5", *options, *INFERRED)
    assert code == 0
    assert "the equation of theta holds in all 2 episodes" in out
    assert "warning" not in out
    for a, b in zip(load_dataset("D.h5"), load_dataset("E.h5"), strict=True):
        assert (a.n_steps, a.dt) == (b.n_steps, b.dt)
        apart = (a.column("theta") - b.column("theta") + math.pi) % TURN - math.pi
        assert np.abs(apart).max() < 2e-4
        assert np.abs(b.column("theta")).max() <= math.pi
        assert np.abs(a.actions - b.actions).max() < 3.0
        assert a.observation_columns == b.observation_columns
        for velocity in ("x_dot", "theta_dot"):
            assert np.abs(a.column(velocity) - b.column(velocity)).max() < 0.05
        lacking = "x_dot, theta_dot: not recorded, the change of their positions"
        assert (lacking in b.provenance.notes) == (kind == "no velocities")


UNDECLARED = {
    "hanging": (hanging, ("--rate", 1000), "fits better with the zero of theta half a turn away"),
    "degrees": (degrees, ("--rate", 1000), "fits better with theta in deg"),
    "times": (timed, ("--rate", 1000), "x rises evenly from row to row, as times do: name the "),
    "500 Hz": (
        lambda table: table[::2],
        ("--rate", 1000),
        "fits better with a rate of 500 Hz instead of 1000 Hz",
    ),
    "another sign": (
        lambda table: table * [1, 1, -1, -1],
        ("--rate", 1000),
        "fits better with theta or x with the opposite sign",
    ),
    "another mass": (
        lambda table: table,
        ("--rate", 1000, "--set", "pole_inertia=0.4"),
        "fits better with",
    ),
}


@pytest.mark.parametrize("kind", UNDECLARED)
def test_what_nobody_declared_is_named(attempts, misstep, kind):
    change, options, named = UNDECLARED[kind]
    files = written([change(table) for table in rows(attempts)[:2]])
    stated = [word for word in INFERRED if "pole_inertia" not in word or "--set" not in options]
    code, out = misstep("convert", *files, "D.h5", "--columns", COLUMNS, *options, *stated)
    assert code == 0
    assert named in out
    assert "warning: the recording" in out


def test_several_attempts_in_one_file(attempts, misstep):
    tables = [np.column_stack([np.full(len(t), i), t]) for i, t in enumerate(rows(attempts)[:3])]
    written([np.concatenate(tables)], "all")
    code, _ = misstep(
        "convert", "all0.csv", "D.h5", "--episode", 0, "--columns", COLUMNS, "--rate", 1000,
        *INFERRED,
    )  # fmt: skip
    assert code == 0
    assert [t.n_steps for t in load_dataset("D.h5")] == [200, 200, 200]


def test_a_failure_that_holds_from_the_start_is_named(attempts, misstep):
    files = written(rows(attempts)[:1])
    words = ("--columns", COLUMNS, "--rate", 1000, "--failure", "abs(theta) > 30deg")
    code, out = misstep("convert", *files, "D.parquet", *words)
    assert code == 0
    assert "warning: 1 of 1 attempts fail at their first observation" in out


def test_equations_that_cannot_be_checked_say_why(attempts, misstep):
    files = written(rows(attempts)[:1])
    words = ("--columns", "y:m,b:m/s,theta:rad,d:rad/s", "--rate", 1000)
    code, out = misstep("convert", *files, "D.parquet", *words, "--system", "cartpole")
    assert code == 0
    assert "the equations were not checked: the positions of cartpole are x, theta" in out
    code, out = misstep("convert", *files, "E.parquet", *words, "--system", "flipup")
    assert code == 0
    assert "equation" not in out


def test_every_format_says_what_it_is_and_can(misstep, here):
    code, out = misstep("list", "formats", "--json", "f.json")
    assert code == 0
    entries = json.loads((here / "f.json").read_text())["formats"]
    assert set(entries) == set(FORMATS)
    for name, entry in entries.items():
        assert entry["summary"] == FORMATS[name].description
        assert entry["reads"] == (FORMATS[name].read is not None)
        assert entry["writes"] == (FORMATS[name].write is not None)
        assert name in out
    assert not entries["db3"]["writes"]
    assert entries["robomimic"]["read_suffixes"] == [".h5", ".hdf5"]
