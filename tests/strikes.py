"""How the tests strike: with a velocity that rises smoothly over the first part of the stroke."""

import numpy as np


def strike(system, speed, start=0.25, rise=0.35, seed=0):
    """Strike once; return the observations, the cost of the last step and its info."""
    observation, info = system.reset(seed=seed)
    observations, over = [observation], False
    while not over:
        assert not info["failed"]
        assert not info["success"]
        u = np.clip(observation[0] / (rise * system.stroke), 0.0, 1.0)
        velocity = speed * (start + (1.0 - start) * u * u * (3.0 - 2.0 * u))
        observation, reward, over, truncated, info = system.step(np.array([velocity]))
        assert not truncated
        observations.append(observation)
    return np.array(observations), -reward, info
