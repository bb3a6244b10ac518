"""What a file says opens no file and no connection, and no token leaves."""

import json
import select
import socket
import threading
from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType

import pytest
import typer

import misstep
from misstep.blame import find_blame
from misstep.cli import main
from misstep.cli.app import app
from misstep.inspection.filmstrip import draw_filmstrip
from misstep.live.jobs import JOBS
from misstep.parameters import parameter_table
from misstep.recordings.checking import check_recorded
from misstep.robot.gazebo.cart_pole import CartPoleGazebo
from misstep.runs import load_config
from misstep.systems import CartPole, CartPoleParameters, recorded_system
from misstep.systems.recorded import system_kind

DESCRIPTION = {
    "observations": "x m, x_dot m/s, theta rad, theta_dot rad/s",
    "actions": "force N",
    "low": "-10",
    "high": "10",
    "dt": 0.02,
}


@pytest.fixture
def listener(monkeypatch):
    """A socket that listens, and to which nobody may ever have spoken."""
    monkeypatch.setenv("MISSTEP_TOKEN", "my-secret-token")
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server
        assert not select.select([server], [], [], 0.1)[0], "somebody connected"


@pytest.fixture(params=[{}, DESCRIPTION], ids=["address alone", "described"])
def hostile(request, listener, tmp_path, monkeypatch):
    """A folder with a recording and a run of a stranger that name a robot at the listener."""
    monkeypatch.chdir(tmp_path)
    parameters = {**request.param, "address": f"127.0.0.1:{listener.getsockname()[1]}"}
    system = misstep.make_system("cartpole", duration=2.0)
    shown = misstep.demonstrate(system, by="weak", n=3, seed=0)
    misstep.learn(system, shown, "mean", max_trials=2, stop_on_success=False, out="RUN")
    stolen = {"system": "remote", "parameters": MappingProxyType(parameters)}
    misstep.save_dataset(
        misstep.Dataset([replace(t, provenance=replace(t.provenance, **stolen)) for t in shown]),
        "D.h5",
    )
    config = json.loads((tmp_path / "RUN/run.json").read_text())
    config |= {"system": "remote", "system_parameters": parameters, "max_trials": 5}
    (tmp_path / "RUN/run.json").write_text(json.dumps(config))
    lines = [f'{name} = "{value}"' for name, value in parameters.items() if name != "dt"]
    (tmp_path / "S.toml").write_text(
        '[study]\nname = "s"\n[[case]]\nname = "c"\nsystem = "remote"\n'
        'demonstrators = ["random"]\nlearners = ["mean"]\n[case.set]\n'
        + "\n".join([*lines, "dt = 0.02"])
    )
    return tmp_path


# Every command, with files of a stranger wherever it takes one; None: it takes none.
COMMANDS = {
    "inspect": ["inspect D.h5 --out P.html --json J.json"],
    "mark": ["mark D.h5 --episode 1 --outcome failure"],
    "convert": ["convert D.h5 E.csv", "convert D.h5 E.h5 --to-rate 25", "convert D.h5 E.minari"],
    "learn": ["learn remote --from D.h5 --learner mean", "learn cartpole --from D.h5"],
    "resume": ["resume RUN", "resume RUN --system remote"],
    "evaluate": ["evaluate RUN --episodes 1", "evaluate RUN --episodes 1 --system remote"],
    "serve": ["serve NEW --from D.h5 --learner mean --system remote --set low=1 --set high=-1"],
    "explain": ["explain D.h5"],
    "study": ["study S.toml --out O --workers 1"],
    "demonstrate": None,
    "live": None,  # what it takes comes from its page, below
    "drive": None,
    "offer": None,
    "reproduce": None,
    "bench": None,
    "list": None,
    "ros1": None,  # in a graph; its runs are opened as serve's are
    "ros2": None,
}


def test_every_command_is_known_here():
    assert set(typer.main.get_command(app).commands) == set(COMMANDS)


@pytest.mark.parametrize("line", [line for lines in COMMANDS.values() for line in lines or ()])
def test_no_command_connects_to_an_address_in_a_file(hostile, line, capsys):
    main(line.split())
    assert "Traceback" not in capsys.readouterr().err


def test_no_job_of_the_page_connects_to_an_address_in_a_file(hostile):
    def tell(kind, value):
        pass

    given = {"system": "cartpole", "parameters": {}}
    taken = JOBS["read"](tell, lambda: "next", path=str(hostile / "D.h5"), **given)
    assert len(taken) == 3
    for job, arguments in (
        ("describe", {"attempts": str(hostile / "D.h5")}),
        ("describe", {"attempts": str(hostile / "D.h5"), "system": "remote"}),
        ("resume", {"folder": str(hostile / "RUN")}),
        ("resume", {"folder": str(hostile / "RUN"), "system": "remote"}),
        ("show_run", {"folder": str(hostile / "RUN")}),
    ):
        with suppress(misstep.MisstepError):
            JOBS[job](tell, lambda: "next", **arguments)


def test_python_does_not_connect_to_an_address_in_a_run(hostile):
    with pytest.raises(misstep.MisstepError, match="address"):
        misstep.resume(misstep.load_run("RUN"))


def test_an_address_that_the_user_gives_gets_the_token(monkeypatch):
    monkeypatch.setenv("MISSTEP_TOKEN", "my-secret-token")
    heard = []

    def hear(server):
        with server.accept()[0] as connection:
            heard.append(connection.recv(4096))

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=hear, args=[server])
        thread.start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        system = recorded_system("remote", {**DESCRIPTION, "address": "x:1"}, {"address": address})
        with pytest.raises(misstep.MisstepError, match=address):
            system.reset(seed=0)
        thread.join()
    assert b"my-secret-token" in heard[0]


def test_only_classes_that_say_so_are_built_from_a_file(refused):
    class Derived(CartPole):
        system_id = "derived"

    assert CartPole.typed_only == frozenset()
    assert Derived.typed_only is None
    assert CartPoleGazebo.typed_only is None
    for name in ("gym:Pendulum-v1", "cartpole-gazebo"):
        assert system_kind(name).typed_only is None
        with refused(f"{name} is not built from what a file says"):
            recorded_system(name, {})


def test_a_text_in_a_file_opens_no_path(refused, tmp_path):
    path = str(tmp_path / "model.xml")
    with refused("gym:Ant-v5 was recorded with xml_file=.*; give it"):
        recorded_system("gym:Ant-v5", {"xml_file": path, "success": "o0 > 1"}, typed=True)
    with refused(f"cannot be made.*{path}"):
        recorded_system("gym:Ant-v5", {}, {"xml_file": path, "success": "o0 > 1"}, typed=True)


def test_a_file_says_nothing_but_parameters_of_a_simulation(refused):
    with refused("cartpole has no parameter 'render_mode'"):
        recorded_system("cartpole", {"render_mode": "rgb_array"})


def test_a_run_of_something_else_is_opened_by_its_name(tmp_path, refused):
    system = misstep.make_system("gym:InvertedPendulum-v5", duration=1.0)
    shown = misstep.demonstrate(system, "random", n=3, seed=0)
    misstep.learn(system, shown, "mean", max_trials=1, seed=0, out=tmp_path / "run")
    config = load_config(tmp_path / "run")
    assert config.make_system().parameters == system.parameters
    with refused("the run drives gym:InvertedPendulum-v5 and not cartpole"):
        config.make_system(typed="cartpole")
    with refused("the run was made with duration=1.0"):
        config.make_system({"duration": 2.0})
    with refused("cartpole-gazebo is not built"):
        replace(config, system="cartpole-gazebo").make_system()


NUMBERS = (0, -1, 1e308, 5e-324, 1e-9, 1e9)


@pytest.fixture(scope="module")
def attempts():
    system = misstep.make_system("cartpole", duration=3.0)
    shown = misstep.demonstrate(system, by="weak", n=3, seed=0)
    return tuple(shown), find_blame(shown)[0]


@pytest.mark.parametrize("name", [row.name for row in parameter_table(CartPoleParameters)])
def test_numbers_beyond_reckoning_end_in_one_line(attempts, name):
    """Nothing but words comes of them: no other exception, no warning, no endless picture."""
    shown, blame = attempts
    for value in NUMBERS:
        stated = {**shown[0].provenance.parameters, name: value}
        changed = [replace(t, provenance=replace(t.provenance, parameters=stated)) for t in shown]
        lines = check_recorded(changed).lines()
        assert lines
        assert not any("nan" in line.split() for line in lines)
        with suppress(misstep.MisstepError):
            draw_filmstrip(changed[0], blame)
