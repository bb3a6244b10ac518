"""Ten lines from four failures to a policy: balance a pole that nobody could balance."""

import misstep

system = misstep.make_system("cartpole")
failures = misstep.demonstrate(system, by="noisy", n=4, seed=0)
run = misstep.learn(system, failures, "fall", state=("theta", "theta_dot"), max_trials=5, seed=0)
result = misstep.evaluate(system, run.policy, episodes=20, seed=1)

low, high = result.interval_95
print(f"{len(run.trials)} trials, success: {run.succeeded}")
print(f"the last policy balances from {result.success_rate:.0%} of starts, {low:.0%} to {high:.0%}")
