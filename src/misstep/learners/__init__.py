"""Strategies that turn failed attempts into the next policy: one strategy a file, one registry."""

from misstep.learners.donut import DonutLearner, DonutPolicy
from misstep.learners.donut_cost import DonutCostLearner
from misstep.learners.fall import Fall
from misstep.learners.learner import LEARNERS, Evidence, LearnedPolicy, Learner, Task
from misstep.learners.mean import Mean, MeanPolicy
from misstep.learners.mixtures import MixturePolicy

__all__ = [
    "LEARNERS",
    "DonutCostLearner",
    "DonutLearner",
    "DonutPolicy",
    "Evidence",
    "Fall",
    "LearnedPolicy",
    "Learner",
    "Mean",
    "MeanPolicy",
    "MixturePolicy",
    "Task",
]
