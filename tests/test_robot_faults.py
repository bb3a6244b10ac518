"""Two hundred faults: nothing finished is lost, and the last action sent is the safe one."""

import os
import signal
import socket
import subprocess
import sys

from robot_faults import SECRET, WAYS, harm, until

from misstep import load_run, save_dataset
from misstep.robot.addresses import TOKEN
from misstep.robot.client import RobotClient
from misstep.robot.limits import Reason
from misstep.robot.log import Sent, read_log

N_FAULTS = 200


def test_after_two_hundred_faults_nothing_is_lost_and_the_robot_is_safe(demonstrations, tmp_path):
    made, kept = harm(tmp_path, demonstrations, N_FAULTS)
    assert sum(made.values()) == N_FAULTS
    assert len(made) == len(WAYS) == 12
    assert kept > N_FAULTS // 10


# A service that is killed

PROGRAM = "import sys; from misstep.cli import main; sys.exit(main())"
LATER = ("--watchdog-ms", "10000", "--deadline-ms", "10000")


def test_a_killed_service_has_lost_nothing_and_its_robot_is_safe(
    demonstrations, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(TOKEN, SECRET)
    save_dataset(demonstrations, "D.h5")
    new = ("--from", "D.h5", "--system", "cartpole", "--learner", "mean", "--max-trials", "100")
    finished = 0
    for turn in range(2):
        words = ("serve", "RUN", *(new if turn == 0 else ()), "--socket", "unix:s", *LATER)
        serving = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *words], stdout=subprocess.DEVNULL
        )
        until(lambda: is_listening("s"))
        robot = RobotClient("unix:s", patience=60.0, timeout=60.0)
        assert robot.start().number == finished
        for _ in range(3):
            assert robot.ask((0.0, 0.0, 0.1, 0.0), cost=1.0).in_trial
        robot.ask((0.0, 0.0, 0.6, 0.0), cost=9.0, failed=True, over=True)
        finished = robot.start().number
        assert robot.ask((0.0, 0.0, 0.1, 0.0)).action != (0.0,)
        os.kill(serving.pid, signal.SIGKILL)
        serving.wait()
        command = robot.ask((0.0, 0.0, 0.1, 0.0))
        assert (command.action, command.in_trial) == ((0.0,), False)
        assert command.reason & Reason.SILENT
        robot.close()
        run = load_run("RUN")
        assert [trial.n_steps for trial in run.trials] == [3] * finished == [3] * (turn + 1)
        records = list(read_log(f"RUN/actions/{turn:04d}.log")[1])
        assert isinstance(records[-1], Sent)  # the last word of the killed one
        assert records[-1].reason & Reason.POLICY


def is_listening(path):
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(path) == 0
