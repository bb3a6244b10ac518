"""What the nodes of ROS 1 and ROS 2 have in common, without either: real physics, no middleware."""

from collections.abc import Sequence

import numpy as np
import pytest
from ros_graphs import untimed

import misstep
from misstep.errors import MisstepError
from misstep.learning import begin
from misstep.robot.guard import Command, State
from misstep.robot.ros.exploring import explore
from misstep.robot.ros.joint_system import JointStates, JointSystem
from misstep.robot.ros.joints import Joints
from misstep.robot.ros.plant import Plant
from misstep.robot.service import ExplorationService, Start
from misstep.trajectory import Column

FINE = {"physics_step": 0.001, "duration": 1.5}


class LockedPlant:
    """A plant in lock-step, called instead of wired."""

    lock_step = True

    def __init__(self, plant: Plant) -> None:
        self.plant, self.ticks, self.states, self.sent = plant, 0, [], []

    def reset(self, seed: int | None) -> float:
        self.plant.reset(seed)
        return self._publish()

    def receive(self, timeout: float) -> JointStates | None:
        return self.states.pop(0) if self.states else None

    def send(self, efforts: Sequence[float]) -> None:
        self.sent.append(tuple(efforts))
        self.plant.step(tuple(efforts))
        self._publish()

    def _publish(self) -> float:
        self.ticks += 1
        stamp = self.ticks / self.plant.rate
        self.states.append(JointStates(stamp, self.plant.observation))
        return stamp


def wired(name: str = "cartpole", rate: float = 0.0, **parameters) -> tuple[JointSystem, Plant]:
    plant = Plant(name, parameters, rate)
    described = misstep.make_system(name, **parameters)
    return JointSystem(described, LockedPlant(plant)), plant


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("cartpole", FINE),
        ("cartpole", {**FINE, "stop_at_fall": False, "start_angle": 0.6}),
        ("cartpole", {**FINE, "upright_time": 0.5, "upright_angle_deg": 2.0, "delay": 0.013}),
        ("cartpole", {"duration": 3.0, "track_limit": 0.3, "control_rate": 20.0}),
        ("cartpole-swingup", {"duration": 6.0}),
    ],
)
def test_a_robot_on_topics_is_demonstrated_on_as_the_system_itself(name, parameters):
    driven, plant = wired(name, **parameters)
    own = misstep.make_system(name, **parameters)
    kind = {"by": "random", "n": 3, "seed": 4}
    assert untimed(misstep.demonstrate(driven, **kind)) == untimed(misstep.demonstrate(own, **kind))
    if "physics_step" in parameters:
        assert plant.rate == 1000.0


def test_states_more_often_than_the_physics_steps_are_another_simulation():
    driven, _ = wired(rate=1000.0, duration=2.0)
    own = misstep.make_system("cartpole", duration=2.0)
    coarse = misstep.demonstrate(own, "weak", n=1, seed=1)[0]
    fine = misstep.demonstrate(driven, "weak", n=1, seed=1)[0]
    n = min(len(coarse.actions), len(fine.actions))
    assert not np.array_equal(coarse.observations[:n], fine.observations[:n])
    np.testing.assert_allclose(coarse.observations[:n], fine.observations[:n], atol=1e-5)


class Direct:
    """An exploration service, called instead of wired."""

    def __init__(self, service: ExplorationService) -> None:
        self.service, self.sequence = service, 0

    def start(self) -> Start | None:
        self.service.wait()
        return self.service.start()

    def ask(self, observation, **said) -> Command:
        self.sequence += 1
        stamp = said.pop("stamp")
        return self.service.exchange(State(self.sequence, stamp, observation, **said))


def test_exploration_through_joint_states_is_that_of_learn():
    settings = {"state": ("theta", "theta_dot"), "max_trials": 3, "seed": 2}
    own = misstep.make_system("cartpole", **FINE)
    shown = misstep.demonstrate(own, "weak", n=3, seed=0)
    expected = misstep.learn(own, shown, "donut", stop_on_success=False, **settings)
    run = begin(own, shown, "donut", stop_on_success=False, **settings)
    service = ExplorationService(run, system=own, simulated_time=True)
    driven, plant = wired(**FINE)
    assert explore(Direct(service), driven) == 3
    service.close()
    assert untimed(run.trials) == untimed(expected.trials)
    assert plant.efforts == (0.0, 0.0)  # left with the safe effort


def test_a_robot_that_falls_silent_is_sent_the_safe_effort():
    class Silent(LockedPlant):
        def receive(self, timeout):
            return super().receive(timeout) if len(self.sent) < 5 else None

    robot = Silent(Plant("cartpole", {}))
    driven = JointSystem(misstep.make_system("cartpole"), robot, patience=0.05)
    driven.reset(seed=0)
    push = np.array([3.0])
    driven.step(push)
    driven.step(push)
    with pytest.raises(MisstepError, match=r"no joint state for 0\.05 s: the safe effort was sent"):
        driven.step(push)
    assert robot.sent[-1] == (0.0,)
    assert set(robot.sent[:-1]) == {(3.0,)}


def test_joints_go_there_and_back_whatever_they_are_called():
    columns = misstep.make_system("cartpole").observation_columns
    joints = Joints(columns, {"x": "slide", "theta": "hinge"})
    assert joints.names == ("slide", "hinge")
    positions, velocities = joints.arrays((1.0, 2.0, 3.0, 4.0))
    assert (positions, velocities) == ([1.0, 3.0], [2.0, 4.0])
    # A robot has more joints, in an order of its own.
    told = joints.observation(("hinge", "lid", "slide"), (3.0, 9.0, 1.0), (4.0, 9.0, 2.0))
    assert told == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"y": "slide"}, "no joint 'y' to rename; there are: x, theta"),
        ({"x": "theta"}, "two joints have one name: theta, theta"),
    ],
)
def test_wrong_names_of_joints_are_refused(names, message):
    with pytest.raises(MisstepError, match=message):
        Joints(misstep.make_system("cartpole").observation_columns, names)


def test_a_joint_state_without_velocities_is_refused():
    joints = Joints([Column("x", "m"), Column("x_dot", "m/s")])
    with pytest.raises(MisstepError, match="no velocity of x; its joints: x"):
        joints.observation(("x",), (1.0,), ())


@pytest.mark.parametrize(("name", "rate"), [("cartpole", 75.0), ("cartpole", 20.0), ("basket", 0)])
def test_what_cannot_be_simulated_on_topics_is_refused(name, rate):
    with pytest.raises(MisstepError, match=r"multiple of the control rate|no cart-pole"):
        Plant(name, {}, rate)
