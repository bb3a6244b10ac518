"""`dynamics-policy`: learn how the system responds, and in that a small policy beforehand.

The same forward model as that of `dynamics`, for systems that cannot plan at every step. CMA-ES
searches the weights of a small network by rollouts in the model; a control step then costs a few
products.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.dynamics import Circles, Encoding
from misstep.dynamics.imagination import Imagination, search_network
from misstep.errors import MisstepError
from misstep.learners.dynamics import (
    Learned,
    ModelParameters,
    learn_dynamics,
    restored_circles,
)
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.parameters import check_parameters, parameter

Array = NDArray[np.float64]

# Other starts lie around those recorded, at this share of the spread of all that was recorded.
START_SPREAD = 0.02


class NetworkPolicy:
    """u = tanh(outer [tanh(inner [z, 1]), 1]), z the encoded state; deterministic.

    Parameters
    ----------
    task : Task
    circles : Circles
    encoding : Encoding
        Of the unrolled state.
    inner : ndarray, shape (units, nz + 1)
    outer : ndarray, shape (m, units + 1)
    """

    def __init__(
        self, task: Task, circles: Circles, encoding: Encoding, inner: Array, outer: Array
    ) -> None:
        self.task = task
        self.circles = circles
        self.encoding = encoding
        self.inner = inner
        self.outer = outer
        self._indices = task.state_indices

    def reset(self) -> None:
        """Forget the attempt before: nothing is remembered."""

    def __call__(self, observation: Array, /) -> Array:
        """Return the action at an observation, inside the actuator's limits."""
        state = np.asarray(observation[self._indices], dtype=np.float64)
        z = self.encoding.encode(self.circles.unroll(state)[None])[0]
        hidden = np.tanh(self.inner[:, :-1] @ z + self.inner[:, -1])
        action = np.tanh(self.outer[:, :-1] @ hidden + self.outer[:, -1])
        return self.encoding.decode_actions(action)

    def arrays(self) -> dict[str, Array]:
        """Return the weights and what they refer to."""
        e = self.encoding
        circles = self.circles.pairs.astype(np.float64)
        scales = {"angles": e.angles.astype(np.float64), "mean": e.mean, "scale": e.scale}
        return {"circles": circles, **scales, "inner": self.inner, "outer": self.outer}


@LEARNERS.register("dynamics-policy")
@dataclass(frozen=True)
class DynamicsPolicySearch(ModelParameters):
    """Rung 4: a forward model learned from every attempt, and a small policy searched in it."""

    units: int = parameter(16, "", "hidden units of the policy", at_least=1, at_most=200)
    horizon: int = parameter(
        250, "control periods", "length of an imagined rollout", at_least=2, at_most=10_000
    )
    rollouts: int = parameter(
        2, "", "imagined rollouts of a policy, each from another start", at_least=1, at_most=1000
    )
    generations: int = parameter(400, "", "generations of CMA-ES", at_least=1)
    population: int = parameter(40, "", "policies in a generation", at_least=4, at_most=10_000)

    def __post_init__(self) -> None:
        check_parameters(self, "learner dynamics-policy")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> NetworkPolicy:
        """Return the best policy found in the model of all attempts.

        Raises
        ------
        MisstepError
            If the task has no cost as a function, an action without limits, or there are too few
            transitions to learn from.
        """
        learned = learn_dynamics(task, evidence, rng, self.centres, self.trial_seconds)
        imagination = Imagination(
            learned.model.compiled(),
            learned.cost,
            *starts_and_noise(learned, self.rollouts, self.horizon, rng),
        )
        inner, outer = search_network(
            imagination, self.units, self.generations, self.population, rng
        )
        return NetworkPolicy(task, learned.circles, learned.model.encoding, inner, outer)

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> NetworkPolicy:
        """Return the policy that `NetworkPolicy.arrays` described.

        Raises
        ------
        MisstepError
            If the arrays fit neither each other nor the task.
        """
        circles = restored_circles(task, arrays)
        n, m = len(circles.kept), len(task.action_columns)
        angles = np.asarray(arrays["angles"], dtype=np.bool_)
        nz, units = n + int(angles.sum()), len(arrays["inner"])
        wanted = {
            "angles": (n,),
            "mean": (n,),
            "scale": (n,),
            "inner": (units, nz + 1),
            "outer": (m, units + 1),
        }
        for name, shape in wanted.items():
            values = arrays[name]
            if values.shape != shape or not np.isfinite(values).all():
                raise MisstepError(
                    f"the policy's {name} has shape {values.shape}: finite numbers of shape "
                    f"{shape} are wanted"
                )
        if not np.all(arrays["scale"] > 0.0):
            raise MisstepError(
                f"the policy's scale is {arrays['scale'].tolist()}: not all positive"
            )
        limits = task.action_low, task.action_high
        encoding = Encoding(angles, arrays["mean"], arrays["scale"], *limits)
        return NetworkPolicy(task, circles, encoding, arrays["inner"], arrays["outer"])


def starts_and_noise(
    learned: Learned, rollouts: int, horizon: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return where rollouts start (R, n), and what is added after each of their steps (R, H, n).

    The first starts where an attempt did and goes as the model says. The others start beside, and
    have as much noise as the model leaves unexplained.
    """
    starts = np.array([states[0] for states, _ in learned.recordings])
    states = np.concatenate([states[:-1] for states, _ in learned.recordings])
    actions = np.concatenate([actions for _, actions in learned.recordings])
    chosen = starts[rng.integers(len(starts), size=rollouts)]
    chosen[1:] += START_SPREAD * states.std(axis=0) * rng.standard_normal(chosen[1:].shape)

    kinematics = learned.model.kinematics
    noise = rng.standard_normal((rollouts, horizon, states.shape[1]))
    noise *= np.sqrt(np.median(learned.model.variance(states, actions), axis=0))
    integrals = np.flatnonzero(kinematics.source >= 0)
    # An integral has no noise of its own.
    noise[:, :, integrals] = kinematics.beta[integrals] * noise[:, :, kinematics.source[integrals]]
    noise[0] = 0.0
    return chosen, noise
