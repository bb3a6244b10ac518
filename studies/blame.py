"""How exactly the point of no return is found, where the true one is known.

Failed demonstrations of the cart-pole by all six kinds of demonstrators, in sets of four as a user
would have. The true point of no return is the last recorded observation from which the pole can
still be kept from falling in MuJoCo itself: the state is restored, and a saturated controller tries
with several leads and gains for three seconds. That nothing better was missed is checked by the
other bound: full force towards the fall, the hardest there is against it, no longer turns the pole
round before it has fallen.

Compared are

plans            trying plans in a model learned from the four recordings (`misstep.blame`)
plans, unlimited the same without knowing the actuator's limit: the largest force seen takes its
                 place, and what a stronger force could have saved is then held to be lost
growth           how the failures grew (what `misstep.learners.fall` learns), no model
end              the time of the failure itself
end, shifted     the same, earlier by what is best on average with hindsight: what one would say
                 who knew the answers, and nothing of the single attempt

    python studies/blame.py
    python studies/blame.py --force-limit 5
"""

import argparse

import numpy as np

from misstep.blame import ActionLimits, Recovery, action_limits
from misstep.blame.growth import growth_dangers
from misstep.demonstrators import demonstrate
from misstep.systems import make_system
from misstep.trajectory import Dataset, Trajectory

KINDS = ("noisy", "weak", "delayed", "reversed", "random", "bang-bang")
SET = 4
LEADS = (0.2, 0.27, 0.35, 0.5)
"""How far ahead of the angle the controller looks, s: sqrt(4 l / 3 g) = 0.26 s and around it."""
GAINS = (60.0, 20_000.0)
"""N/rad: one that lands softly, and one that is full force either way."""
LASTS = 3.0
RESAMPLES = 2000


def survives(system, state, controller) -> bool:
    """Whether the true system, started at a state, does not fail under a controller."""
    system.set_state(*state)
    observation = np.array(state)
    for _ in range(round(LASTS / system.dt)):
        observation, _, _, _, info = system.step(controller(observation))
        if info["failed"]:
            return False
    return True


def recoverable(system, state) -> bool:
    """Whether a saturated controller saves the true system: the inner bound."""
    return any(
        survives(system, state, lambda s, c=c, k=k: np.array([k * (s[2] + c * s[3])]))
        for k in GAINS
        for c in LEADS
    )


def can_be_turned(system, state, way) -> bool:
    """Whether full force towards the fall turns the pole before it has fallen: the outer bound."""
    system.set_state(*state)
    force = np.array([way * system.parameters["force_limit"]])
    for _ in range(round(LASTS / system.dt)):
        observation, _, _, _, info = system.step(force)
        if info["failed"]:
            return False
        if way * observation[3] < 0:
            return True
    return False


def last(trajectory: Trajectory, holds) -> int:
    """Return the last observation before the failure of which `holds` is true; −1 if none."""
    steps = range(trajectory.failure_step - 1, -1, -1)
    return next((t for t in steps if holds(trajectory.observations[t])), -1)


def last_safe(danger) -> int:
    """Return the last index at which the danger is below 1; −1 if none."""
    safe = np.flatnonzero(danger < 1.0)
    return int(safe[-1]) if len(safe) else -1


def found(shown: Dataset, limits: ActionLimits, seed: int) -> list[int]:
    """Return the points of no return that plans in a learned model find, as observations."""
    recovery = Recovery.learn(shown, limits, np.random.default_rng(seed))
    if not all(recovery.boundary.told):
        raise RuntimeError("a failure was not recognised as leaving a range")
    return [last_safe(recovery.danger(t.observations[: t.failure_step])) for t in shown]


def largest_seen(shown: Dataset) -> ActionLimits:
    """Return the limits that the actions alone suggest."""
    largest = np.abs(np.concatenate([t.actions for t in shown])).max(axis=0)
    return ActionLimits(-largest, largest, "the largest seen", False)


def interval(errors, statistic) -> tuple[float, float]:
    """Return the 95 % bootstrap interval; sets are drawn whole, as their errors go together."""
    rng = np.random.default_rng(0)
    sets = [errors[i : i + SET] for i in range(0, len(errors), SET)]
    values = [
        statistic(np.concatenate([sets[i] for i in rng.integers(len(sets), size=len(sets))]))
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectories", type=int, default=200)
    parser.add_argument("--force-limit", type=float, default=20.0, help="N")
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    system = make_system("cartpole", force_limit=arguments.force_limit)
    true, outer, ends = [], [], []
    steps: dict[str, list[int | None]] = {"plans": [], "plans, unlimited": [], "growth": []}
    for i in range(arguments.trajectories // SET):
        seed = arguments.first_seed + i
        shown = demonstrate(system, KINDS[i % len(KINDS)], SET, seed)
        steps["plans"] += found(shown, action_limits(shown), seed)
        steps["plans, unlimited"] += found(shown, largest_seen(shown), seed)
        steps["growth"] += [
            None if d is None else last_safe(d[: t.failure_step])
            for d, t in zip(growth_dangers(shown), shown, strict=True)
        ]
        for t in shown:
            way = np.sign(t.observations[t.failure_step, 2])
            true.append(last(t, lambda s: recoverable(system, s)))
            outer.append(last(t, lambda s, way=way: can_be_turned(system, s, way)))
            ends.append(t.failure_step)
    truth, end = np.array(true), np.array(ends)
    shift = int(np.median(end - truth))
    apart = np.array(outer) - truth
    print(
        f"{len(truth)} failed trajectories, ±{arguments.force_limit:g} N; the true point of no "
        f"return is {np.median(end - truth) * system.dt:.2f} s before the failure (median; "
        f"{(end - truth).min() * system.dt:.2f} to {(end - truth).max() * system.dt:.2f} s)"
    )
    print(f"inner and outer bound differ in {np.count_nonzero(apart)}, by {apart.max()} step(s)")
    print(
        f"{'method':18}{'n':>5}  {'median [95 %]':>22}  {'90 % error [95 %]':>22}  exact  bias, s"
    )
    rows = {**steps, "end": list(end), "end, shifted": list(end - shift)}
    for name, values in rows.items():
        signed = np.array([np.nan if v is None else v for v in values]) - truth
        known = ~np.isnan(signed)
        errors = np.abs(signed) * system.dt
        cells = []
        for statistic in (np.nanmedian, lambda e: np.nanquantile(e, 0.9)):
            low, high = interval(errors, statistic)
            cells.append(f"{statistic(errors):.3f} [{low:.3f}, {high:.3f}]")
        print(
            f"{name:18}{known.sum():5}  {cells[0]:>22}  {cells[1]:>22}  "
            f"{np.mean(signed[known] == 0):5.0%}  {np.nanmean(signed) * system.dt:+.3f}"
        )


if __name__ == "__main__":
    main()
