"""Your own system: an environment of Gymnasium, and what counts as a failure in a formula.

A notebook as a script: run it whole, or cell by cell in an editor that knows ``# %%``.
"""

# %%
import numpy as np

import misstep

# %% [markdown]
# Any environment with `Box` spaces: `gym:` and its id. misstep asks it for its columns.

# %%
system = misstep.make_system("gym:InvertedPendulum-v5", failure="abs(theta) > 8deg", duration=5.0)
print([f"{column.name} [{column.unit}]" for column in system.observation_columns])

# %% [markdown]
# Somebody acts at random, four times, and fails. What does a trajectory know?

# %%
failures = misstep.demonstrate(system, by="random", n=4, seed=0)
for attempt in failures:
    print(f"{attempt.outcome} after {attempt.failure_time:.2f} s, {attempt.n_steps} steps")

# %% [markdown]
# Learn until a trial succeeds: it must last 5 s. `fall` is told only when each attempt failed.

# %%
run = misstep.learn(system, failures, "fall", state=("theta", "theta_dot"), max_trials=10, seed=0)
print(f"{len(run.trials)} trials, success: {run.succeeded}")

# %% [markdown]
# A judge may be a function of the observation. How good is the policy if the cart must stay near
# the middle, too?

# %%
strict = misstep.make_system(
    "gym:InvertedPendulum-v5",
    failure=lambda o: abs(o[1]) > np.radians(8) or abs(o[0]) > 0.9,
    duration=5.0,
)
result = misstep.evaluate(strict, run.policy, episodes=10, seed=1)
low, high = result.interval_95
print(f"{result.successes} of {result.episodes} episodes, {low:.0%} to {high:.0%}")
