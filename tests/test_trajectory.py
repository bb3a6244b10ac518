import copy
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from misstep.errors import MisstepError
from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory

THETA = (Column("theta", "rad"), Column("theta_dot", "rad/s"))
FORCE = (Column("force", "N"),)
PROVENANCE = Provenance("cartpole", {"mass": 0.5, "steps": 3}, "noisy", 7, "2024-05-31T12:00:00Z")


def make(n_steps=3, **changes):
    fields = {
        "observations": np.arange(2.0 * (n_steps + 1)).reshape(-1, 2),
        "actions": np.arange(1.0 * n_steps).reshape(-1, 1),
        "dt": 0.02,
        "observation_columns": THETA,
        "action_columns": FORCE,
        "provenance": PROVENANCE,
    }
    return Trajectory(**{**fields, **changes})


def test_lengths_follow_from_the_actions():
    trajectory = make(150)
    assert trajectory.n_steps == 150
    assert trajectory.duration == pytest.approx(3.0)
    assert trajectory.outcome is Outcome.UNKNOWN
    assert trajectory.costs is None
    assert trajectory.failure_step is None


def test_columns_are_found_by_name_in_the_order_asked_for():
    trajectory = make()
    np.testing.assert_array_equal(trajectory.column("theta_dot"), [1, 3, 5, 7])
    swapped = trajectory.select(["theta_dot", "theta"])
    np.testing.assert_array_equal(swapped, trajectory.observations[:, ::-1])


def test_unknown_column_lists_the_valid_ones():
    with pytest.raises(MisstepError, match=r"no observation column 'tehta'.* theta, theta_dot$"):
        make().column("tehta")
    with pytest.raises(MisstepError, match=r"theta, theta_dot$"):
        make().select(["theta", "x"])


@pytest.mark.parametrize("names", ["theta", []])
def test_select_wants_a_list(names):
    with pytest.raises(MisstepError, match="list of at least one"):
        make().select(names)


def test_arrays_are_copies_that_cannot_be_written():
    source = np.zeros((4, 2), order="F")
    trajectory = make(observations=source, costs=[1, 2, 3])
    source[:] = 9
    assert not trajectory.observations.any()
    for array in (trajectory.observations, trajectory.actions, trajectory.costs):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        trajectory.column("theta")[0] = 1


def test_fields_cannot_be_replaced():
    with pytest.raises(AttributeError):
        make().dt = 1
    with pytest.raises(TypeError):
        PROVENANCE.parameters["mass"] = 2
    with pytest.raises(AttributeError):
        THETA[0].name = "x"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))])  # noqa: S301
def test_copies_are_equal_and_still_read_only(duplicate):
    trajectory = make(costs=[1, 2, 3], failure_step=2, outcome="failure")
    twin = duplicate(trajectory)
    assert twin == trajectory
    assert not twin.observations.flags.writeable
    assert duplicate(Dataset([trajectory])) == Dataset([trajectory])


@pytest.mark.parametrize(
    "changes",
    [
        {"observations": np.ones((4, 2))},
        {"actions": np.ones((3, 1))},
        {"dt": 0.01},
        {"observation_columns": (Column("theta", "deg"), THETA[1])},
        {"action_columns": (Column("torque", "N"),)},
        {"provenance": Provenance("cartpole", {}, "noisy", 7, "")},
        {"provenance": replace(PROVENANCE, notes=("actions: inferred",))},
        {"outcome": Outcome.SUCCESS},
        {"costs": np.zeros(3)},
        {"failure_step": 0},
    ],
)
def test_equality_sees_every_field(changes):
    assert make() == make()
    assert make() != make(**changes)
    assert make(**changes) == make(**changes)
    assert Dataset([make()]) != Dataset([make(**changes)])


def test_equality_is_bit_by_bit():
    assert make(costs=[0.0, 0.0, 0.0]) != make(costs=[0.0, -0.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"observations": np.zeros((3, 2))},
            "observations has 3 rows but actions has 3: "
            "a trajectory of T actions holds T \\+ 1 observations",
        ),
        (
            {"observations": np.zeros((4, 3))},
            r"observations has shape \(4, 3\) .*theta, theta_dot",
        ),
        ({"observations": np.zeros(4)}, r"observations has shape \(4,\)"),
        ({"actions": np.zeros(3)}, r"actions has shape \(3,\) .* \(rows, 1\)"),
        ({"observations": np.zeros((1, 2)), "actions": np.zeros((0, 1))}, "at least one action"),
        ({"actions": [[1.0], [1.0, 2.0], [3.0]]}, "actions is ragged"),
        ({"actions": [["1"], ["2"], ["3"]]}, "actions has dtype <U1"),
        ({"actions": np.zeros((3, 1), complex)}, "actions has dtype complex128"),
        ({"actions": [[None], [1], [2]]}, "actions has dtype object"),
        ({"actions": [[0], [np.inf], [np.nan]]}, "actions row 1, column 'force' is inf"),
        ({"costs": [1, np.nan, 2]}, "costs row 1 is nan"),
        ({"costs": np.zeros(4)}, r"costs has shape \(4,\) but there are 3 actions"),
        ({"costs": np.zeros((3, 1))}, r"costs has shape \(3, 1\)"),
        ({"dt": 0}, "dt is 0.0: it has to be one positive"),
        ({"dt": -0.02}, "dt is -0.02"),
        ({"dt": np.nan}, "dt is nan"),
        ({"dt": np.inf}, "dt is inf"),
        ({"dt": [0.1, 0.2]}, r"dt has shape \(2,\): it has to be one positive"),
        ({"dt": "fast"}, "dt has dtype"),
        ({"failure_step": 4}, "failure_step is 4 but there are 3 actions: .* 0 .. 3"),
        ({"failure_step": -1}, "failure_step is -1"),
        ({"failure_step": 1.5}, "failure_step is 1.5: it has to be a whole number"),
        ({"failure_step": True}, "failure_step is True"),
        ({"outcome": "won"}, "outcome is 'won'; there are: success, failure, unknown"),
        ({"outcome": None}, "outcome is None"),
        ({"provenance": {}}, "has to be a Provenance"),
        ({"observation_columns": (THETA[0], THETA[0])}, "names 'theta' twice"),
        ({"observation_columns": ()}, "observation_columns is empty"),
        ({"observation_columns": ("a", "b")}, "observation_columns holds 'a'"),
        ({"observation_columns": "ab"}, "has to be a tuple of Column"),
        ({"action_columns": None}, "action_columns is None"),
    ],
)
def test_bad_fields_are_refused_in_one_line(changes, line):
    with pytest.raises(MisstepError, match=line) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


@given(st.data())
def test_the_first_bad_value_is_named(data):
    observations = np.zeros((6, 2))
    flat = data.draw(st.sets(st.integers(0, 11), min_size=1))
    observations.ravel()[list(flat)] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    row, column = divmod(min(flat), 2)
    with pytest.raises(MisstepError, match=f"row {row}, column '{THETA[column].name}' is"):
        make(5, observations=observations)


def test_a_part_has_an_outcome_only_if_it_was_decided_in_it():
    whole = make(outcome="success")
    assert whole.cut(3) == whole
    assert whole.cut(2).outcome is Outcome.UNKNOWN
    failed = make(outcome="failure", failure_step=2)
    assert (failed.cut(2).outcome, failed.cut(2).failure_step) == (Outcome.FAILURE, 2)
    assert (failed.cut(1).outcome, failed.cut(1).failure_step) == (Outcome.UNKNOWN, None)
    untimed = make(outcome="failure")
    assert untimed.cut(1).outcome is Outcome.UNKNOWN


@pytest.mark.parametrize("step", [0, 3, np.int64(2)])
def test_failure_step_may_be_any_observation(step):
    assert make(failure_step=step).failure_step == step


@pytest.mark.parametrize(("name", "unit"), [("", "m"), ("a\nb", "m"), (3, "m"), ("a", None)])
def test_bad_columns_are_refused(name, unit):
    with pytest.raises(MisstepError, match="column"):
        Column(name, unit)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"system": "a\0b"}, "the system of a provenance is"),
        ({"system": None}, "the system of a provenance is None"),
        ({"demonstrator": "\ud800"}, "printable"),
        ({"time": "yesterday"}, "ISO 8601"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 2**128}, "2\\*\\*128"),
        ({"seed": 1.0}, "seed is 1.0: it has to be a whole number"),
        ({"parameters": None}, "parameters is None"),
        ({"parameters": {"a": float("nan")}}, "parameter 'a' is nan"),
        ({"parameters": {"a": [1]}}, "parameter 'a' is"),
        ({"parameters": {"a": 2**63}}, "int of 64 bits"),
        ({"parameters": {"a": "x\n"}}, "printable"),
        ({"parameters": {1: 1}}, "the name of a parameter is 1"),
        ({"notes": "actions inferred"}, "notes is 'actions inferred': it lists texts"),
        ({"notes": ["two\nlines"]}, "a note of a provenance is"),
    ],
)
def test_bad_provenance_is_refused(changes, line):
    fields = {"system": "s", "parameters": {}, "demonstrator": "d", "seed": None, "time": ""}
    assert Provenance(**fields).seed is None
    with pytest.raises(MisstepError, match=line) as caught:
        Provenance(**{**fields, **changes})
    assert "\n" not in str(caught.value)


def test_a_provenance_can_be_a_key_and_a_dictionary():
    source = Provenance("cartpole", {"mass": 1.0, "noisy": True}, "person", 3, "")
    assert hash(source) == hash(replace(source))
    assert {source: 1}[replace(source, parameters={"noisy": True, "mass": 1.0})] == 1
    assert asdict(source)["parameters"] == {"mass": 1.0, "noisy": True}
    for change in (
        lambda p: p.update(mass=2.0),
        lambda p: p.__setitem__("mass", 2.0),
        lambda p: p.pop("mass"),
        lambda p: p.clear(),
        lambda p: p.__ior__({"mass": 2.0}),
    ):
        with pytest.raises(TypeError, match="cannot be changed"):
            change(source.parameters)
    assert dict(source.parameters) == {"mass": 1.0, "noisy": True}


def test_parameters_become_plain_python_values():
    given_values = {"f": np.float32(0.5), "i": np.int8(3), "b": np.bool_(True), "s": "text"}
    kept = Provenance("s", given_values, "d", np.uint8(4), "").parameters
    assert {name: type(value) for name, value in kept.items()} == {
        "f": float,
        "i": int,
        "b": bool,
        "s": str,
    }
    assert kept == given_values


def test_dataset_is_a_sequence():
    trajectories = [make(n) for n in (1, 2, 3, 4)]
    dataset = Dataset(iter(trajectories))
    assert len(dataset) == 4
    assert list(dataset) == trajectories
    assert dataset[-1] is trajectories[3]
    assert isinstance(dataset[1:3], Dataset)
    assert list(dataset[1:3]) == trajectories[1:3]
    assert (dataset.dt, dataset.observation_columns, dataset.action_columns) == (0.02, THETA, FORCE)
    with pytest.raises(IndexError):
        dataset[4]


def test_append_leaves_the_old_dataset_alone():
    old = Dataset([make(1)])
    new = old.append(make(2))
    assert [t.n_steps for t in old] == [1]
    assert [t.n_steps for t in new] == [1, 2]


@pytest.mark.parametrize("empty", [lambda: Dataset([]), lambda: Dataset([make()])[1:]])
def test_empty_dataset_is_refused(empty):
    with pytest.raises(MisstepError, match="empty: it needs at least one"):
        empty()


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"dt": 0.01}, "trajectory 2 has dt 0.01 s but trajectory 0 has 0.02 s"),
        (
            {"observation_columns": (THETA[0], Column("theta_dot", "deg/s"))},
            r"trajectory 2 has observation_columns theta \[rad\], theta_dot \[deg/s\] but",
        ),
        ({"action_columns": (Column("torque", "N"),)}, "trajectory 2 has action_columns torque"),
    ],
)
def test_dataset_says_which_trajectory_differs_and_how(changes, line):
    with pytest.raises(MisstepError, match=line):
        Dataset([make(), make(), make(**changes)])
    with pytest.raises(MisstepError, match=line):
        Dataset([make(), make()]).append(make(**changes))


def test_dataset_holds_trajectories_only():
    with pytest.raises(MisstepError, match="item 1 is 3"):
        Dataset([make(), 3])
