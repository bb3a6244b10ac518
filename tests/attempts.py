"""Failed swing-ups by hand, as a person with a heavy cart-pole records them at 1 kHz."""

import numpy as np

from misstep.systems import make_system
from misstep.trajectory import Outcome, Provenance, Trajectory

HEAVY = {
    "cart_mass": 10.0,
    "pole_mass": 5.0,
    "half_length": 1.0,
    "pole_inertia": 1.0,
    "force_limit": 256.0,
    "rail": 15.0,
    "track_limit": 15.0,
    "hinge_damping": 0.0,
    "cart_damping": 0.0,
}
DT = 1e-3


def heavy(**parameters):
    return make_system("cartpole-swingup", **{**HEAVY, **parameters})


def attempt(seed, seconds=6.0, **parameters):
    """Observations (T + 1, 4) and forces (T,) of a hand that pushes left and right."""
    rng = np.random.default_rng(seed)
    system = heavy(control_rate=1000.0, physics_step=DT, duration=20.0, **parameters)
    observation, _ = system.reset(seed=seed)
    strength, direction = rng.uniform(30.0, 120.0), rng.choice([-1.0, 1.0])
    observations, forces, force, wanted, until = [observation], [], 0.0, 0.0, 0.0
    for t in range(round(seconds / DT)):
        if t * DT >= until:
            direction = -np.sign(observation[0]) if abs(observation[0]) > 6 else -direction
            wanted = direction * strength * rng.uniform(0.4, 1.3)
            until = t * DT + rng.uniform(0.3, 1.1)
        force += (wanted - force) * DT / 0.06
        observation, _, terminated, _, info = system.step(np.array([force]))
        observations.append(observation)
        forces.append(info["force"])
        if terminated:
            break
    return np.array(observations), np.array(forces)


def recording(observations, columns, dt=DT):
    """A trajectory of observations whose actions nobody recorded."""
    return Trajectory(
        observations=observations,
        actions=np.zeros((len(observations) - 1, 1)),
        dt=dt,
        observation_columns=columns,
        action_columns=heavy().action_columns,
        provenance=Provenance("", {}, "person", None, ""),
        outcome=Outcome.FAILURE,
    )
