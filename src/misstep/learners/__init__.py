"""Strategies that turn failed attempts into the next policy: one strategy a file, one registry."""

from misstep.learners.between import BalancedMean, RandomScaling, WidestGap
from misstep.learners.choice import default_learner
from misstep.learners.donut import DonutLearner, DonutPolicy
from misstep.learners.donut_cost import DonutCostLearner
from misstep.learners.donut_incremental import DonutIncremental
from misstep.learners.dynamics import Dynamics, DynamicsPolicy
from misstep.learners.dynamics_policy import DynamicsPolicySearch, NetworkPolicy
from misstep.learners.fall import Fall
from misstep.learners.learner import LEARNERS, Evidence, LearnedPolicy, Learner, Task
from misstep.learners.linear import HillClimbing, LinearPolicy, RandomLinear
from misstep.learners.mean import Mean, MeanPolicy
from misstep.learners.mixtures import MixturePolicy
from misstep.learners.search import CmaEs, Power
from misstep.learners.segments import Segments

__all__ = [
    "LEARNERS",
    "BalancedMean",
    "CmaEs",
    "DonutCostLearner",
    "DonutIncremental",
    "DonutLearner",
    "DonutPolicy",
    "Dynamics",
    "DynamicsPolicy",
    "DynamicsPolicySearch",
    "Evidence",
    "Fall",
    "HillClimbing",
    "LearnedPolicy",
    "Learner",
    "LinearPolicy",
    "Mean",
    "MeanPolicy",
    "MixturePolicy",
    "NetworkPolicy",
    "Power",
    "RandomLinear",
    "RandomScaling",
    "Segments",
    "Task",
    "WidestGap",
    "default_learner",
]
