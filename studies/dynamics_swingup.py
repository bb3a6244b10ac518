"""How often, and how fast, `dynamics` swings a pole up from hanging on its first trial.

Four failed demonstrations of 0.7–10 s each (two of random pushes, one person on two keys, one noisy
upright controller), ±10 N, rail ±2.4 m. A trial succeeds if the pole stays within 12° of upright
for its last 5 s and the cart never reaches the end of the rail. A failed trial is added to what the
next model is learned from.

    python studies/dynamics_swingup.py --seeds 10
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np

from misstep.demonstrators import demonstrate
from misstep.learners import Dynamics, Evidence, Task
from misstep.rollout import rollout
from misstep.systems import make_system
from misstep.trajectory import Outcome, Trajectory

DEMONSTRATORS = ("random", "random", "bang-bang", "noisy")
HANGING = {
    "start_angle": math.pi,
    "start_spread": 0.05,
    "stop_at_fall": False,
    "force_limit": 10.0,
    "rail": 2.4,
}
UPRIGHT = math.radians(12.0)
HELD = 5.0
MAX_TRIALS = 5


class Timed:
    """A policy whose every call is timed."""

    def __init__(self, policy):
        self.policy = policy
        self.seconds = []
        self.processor_seconds = []

    def reset(self):
        """Start the policy anew; times are kept."""
        self.policy.reset()

    def __call__(self, observation):
        """Return the policy's action."""
        started, processor = time.perf_counter(), time.thread_time()
        action = self.policy(observation)
        self.seconds.append(time.perf_counter() - started)
        self.processor_seconds.append(time.thread_time() - processor)
        return action


def until_rail(trajectory: Trajectory) -> Trajectory:
    """Return the attempt up to where the cart reached the end of the rail."""
    at_end = np.flatnonzero(np.abs(trajectory.column("x")) >= HANGING["rail"])
    return trajectory.cut(max(1, int(at_end[0]))) if len(at_end) else trajectory


def record(rng: np.random.Generator, contacts: bool) -> tuple[Trajectory, ...]:
    """Record the demonstrations; hanging is a fall, so every one counts as a failure."""
    shown = []
    for by in DEMONSTRATORS:
        system = make_system("cartpole", duration=rng.uniform(0.7, 10.0), **HANGING)
        shown.append(demonstrate(system, by, n=1, seed=int(rng.integers(2**32)))[0])
    return tuple(shown if contacts else map(until_rail, shown))


def succeeded(trial: Trajectory) -> bool:
    """Tell whether a trial swung up and stayed up."""
    last = round(HELD / trial.dt)
    return (
        bool(np.all(np.abs(trial.column("theta")[-last:]) < UPRIGHT))
        and until_rail(trial).n_steps == trial.n_steps
    )


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=0, help="tests from other starts a seed")
    parser.add_argument("--contacts", action="store_true", help="learn from pushing the stops too")
    arguments = parser.parse_args()
    system = make_system("cartpole", duration=10.0, fall_angle_deg=180.0, **HANGING)
    task = Task.of(system)
    learner = Dynamics()
    needed, seconds, processor_seconds, tests = [], [], [], []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        rng = np.random.default_rng(seed)
        shown = record(rng, arguments.contacts)
        trials: list[Trajectory] = []
        for _ in range(MAX_TRIALS):
            started = time.perf_counter()
            policy = Timed(learner.policy(task, Evidence(shown, tuple(trials)), rng))
            fitting = time.perf_counter() - started
            trial = rollout(system, policy, seed=int(rng.integers(2**32)), demonstrator="dynamics")
            # The first step of all compiles; the first of a trial makes its first plan.
            seconds += policy.seconds[1:]
            processor_seconds += policy.processor_seconds[1:]
            success = succeeded(trial)
            if success:
                break
            seen = trial if arguments.contacts else until_rail(trial)
            trials.append(replace(seen, outcome=Outcome.FAILURE))
        needed.append(len(trials) + 1 if success else math.inf)
        for _ in range(arguments.starts if success else 0):
            test = rollout(system, policy, seed=int(rng.integers(2**32)), demonstrator="dynamics")
            tests.append(succeeded(test))
        lengths = " ".join(f"{t.duration:.1f}" for t in shown)
        print(
            f"seed {seed}: {needed[-1]:g} trials; demonstrations {lengths} s; fit {fitting:.1f} s; "
            f"first plan {policy.seconds[0] * 1e3:.0f} ms",
            flush=True,
        )
    first = sum(n == 1 for n in needed)
    print(f"succeeded on the first trial: {first} of {len(needed)}; trials needed: {needed}")
    if tests:
        print(f"tests from other starts: {sum(tests)} of {len(tests)}")
    # The processor's time is what a machine with nothing else to do would take.
    for name, values in (("by the clock", seconds), ("of the processor", processor_seconds)):
        p50, p99, top = np.percentile(1e3 * np.array(values), [50, 99, 100])
        print(f"control step {name}: median {p50:.2f} ms, p99 {p99:.2f} ms, largest {top:.2f} ms")


if __name__ == "__main__":
    main()
