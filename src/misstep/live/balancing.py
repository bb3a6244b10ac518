"""The policy that was learned, live: from one start after another, with a hand at the pole."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.learners import LearnedPolicy
from misstep.live.attempt import Attempt
from misstep.live.hand import Hand
from misstep.systems import make_system

_ENDLESS = 3600.0  # s, an episode
_FALLEN_FOR = 1.5  # s, how long a fallen system lies before it starts again


class Balancing:
    """A policy at work on a system of its own.

    Parameters
    ----------
    name : str
        Of the system.
    parameters : mapping
        Of the system; its episodes are made long.
    policy : LearnedPolicy
    rng : numpy.random.Generator
        For the starts.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, Any],
        policy: LearnedPolicy,
        rng: np.random.Generator,
    ) -> None:
        system = make_system(name, **parameters)
        if "duration" in system.parameters:
            system = make_system(name, **{**parameters, "duration": _ENDLESS})
        self._system = system
        self._policy = policy
        self._rng = rng
        self.hand = Hand(system)
        self._stand_up()

    def _stand_up(self) -> None:
        self.attempt = Attempt(self._system, int(self._rng.integers(2**31)))
        self.action: NDArray[np.float64] = np.zeros(len(self._system.action_columns))
        self._fallen = 0
        self._policy.reset()

    def step(self) -> None:
        """Let one control period pass."""
        if self.attempt.over:
            self._fallen += 1
            if self._fallen * self._system.dt > _FALLEN_FOR:
                self._stand_up()
            return
        self.hand.act()
        self.action = self._policy(self.attempt.observation)
        self.attempt.step(self.action)
