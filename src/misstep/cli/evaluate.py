"""``misstep evaluate``: how often the policy of a run succeeds."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from misstep.cli.options import JsonFile, RunSystem, Seed, run_system
from misstep.cli.output import check_output_file, write_result
from misstep.cli.progress import progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from misstep import Policy


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of `misstep learn --out`.")],
    episodes: Annotated[int, typer.Option(help="How many episodes to run.")] = 100,
    system: RunSystem = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A parameter of the system, in place of the run's own; repeatable.",
        ),
    ] = None,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Run a learned policy from many starts.

    The policy is that of the run's last trial; the interval of its success rate is Wilson's.
    """
    import misstep

    check_output_file(json, "--json")
    driven = run_system(run, system, set_, instead=True)
    loaded = misstep.load_run(run, system=None if system is None else driven)
    config, policy = loaded.config, loaded.policy
    with progress("episode") as report:
        counting = _CountingPolicy(policy, lambda started: report(started - 1, episodes, ""))
        outcome = misstep.evaluate(driven, counting, episodes=episodes, seed=seed)
    low, high = outcome.interval_95
    learner = asdict(config.make_learner())  # type: ignore[call-overload]
    result = {
        "parameters": {"system": driven.parameters, "learner": learner},
        "run": str(run),
        "learner": config.learner,
        "system": config.system,
        "seed": seed,
        "episodes": outcome.episodes,
        "successes": outcome.successes,
        "success_rate": outcome.success_rate,
        "interval_95": [low, high],
        "costs": list(outcome.costs),
    }
    write_result(json, result)
    print(
        f"{outcome.successes} of {outcome.episodes} episodes succeeded: "
        f"{outcome.success_rate:.1%}, 95 % interval {low:.1%} to {high:.1%}"
    )
    return 0


class _CountingPolicy:
    """A policy that tells how many episodes it has started."""

    def __init__(self, policy: "Policy", on_start: Callable[[int], None]) -> None:
        self._policy = policy
        self._on_start = on_start
        self._started = 0

    def reset(self) -> None:
        self._policy.reset()
        self._started += 1
        self._on_start(self._started)

    def __call__(self, observation: "NDArray[np.float64]", /) -> "NDArray[np.float64]":
        return self._policy(observation)


COMMANDS = [("evaluate", evaluate, "misstep evaluate RUN --episodes 100")]
