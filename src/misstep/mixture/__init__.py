"""Mixtures and donuts: what was tried, and where to look instead. Knows no system."""

from misstep.mixture.chunks import RowChunks
from misstep.mixture.conditional import Conditional, Conditioner
from misstep.mixture.donut import Donut, DonutShape
from misstep.mixture.donut_mixture import DonutMixture, exploration_from_variance
from misstep.mixture.gaussian_mixture import GaussianMixture
from misstep.mixture.query import DonutQuery

__all__ = [
    "Conditional",
    "Conditioner",
    "Donut",
    "DonutMixture",
    "DonutQuery",
    "DonutShape",
    "GaussianMixture",
    "RowChunks",
    "exploration_from_variance",
]
