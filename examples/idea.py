"""The idea: two who disagree, the mixture of what they did, and where a donut would explore.

A notebook as a script: run it whole, or cell by cell in an editor that knows ``# %%``.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from misstep import DonutMixture, GaussianMixture
from misstep.mixture import Conditioner, exploration_from_variance

rng = np.random.default_rng(0)

# %% [markdown]
# One pushes with the lean, the other against it. Near upright both do about nothing.

# %%
theta = rng.uniform(-90, 90, size=600)  # deg
side = np.where(np.arange(600) < 300, 1.0, -1.0)
force = side * 0.1 * theta + rng.normal(0, 1.0, size=600)  # N
mixture = GaussianMixture(random_state=0).fit(np.column_stack([theta, force]))
print(f"{mixture.n_components_} components, chosen by minimum BIC")

# %% [markdown]
# Ask the mixture what is usual in a state. Where it varies, explore.

# %%
conditioner = Conditioner(mixture, given=[0])
scale = [3.0]  # N: the disagreement that counts as half
for angle in (0.0, 30.0, 60.0):
    usual = conditioner.at([angle])
    epsilon = exploration_from_variance(usual.variance, scale)
    action = DonutMixture(usual, epsilon).mode()
    print(
        f"{angle:3.0f} deg: force {usual.mean[0]:+5.2f} ± {usual.variance[0, 0] ** 0.5:.2f} N, "
        f"epsilon {epsilon:.2f}, |action| {abs(action[0]):.2f} N"
    )

# %% [markdown]
# The density of what was done at 60°, and the donut of it.

# %%
usual = conditioner.at([60.0])
forces = np.linspace(-20, 20, 401)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].scatter(theta, force, s=4)
axes[0].axvline(60.0, color="tab:green")
axes[0].set(xlabel="θ [deg]", ylabel="force [N]", title="what was done")
for epsilon in (0.0, 0.5, 1.0):
    density = DonutMixture(usual, epsilon).pdf(forces[:, None])
    axes[1].plot(forces, density, label=f"ε = {epsilon:g}")
axes[1].set(xlabel="force [N]", ylabel="density", title="what to do at 60°")
axes[1].legend()
figure.savefig("idea.png")
print("picture in idea.png")
