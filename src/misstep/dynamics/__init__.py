"""Learning how a system responds, and planning in what was learned; knows no learner, no system."""

from misstep.dynamics.circles import Circles
from misstep.dynamics.encoding import Encoding
from misstep.dynamics.forward_model import ForwardModel, Kinematics
from misstep.dynamics.gaussian_process import SparseGaussianProcess
from misstep.dynamics.planner import Planner

__all__ = [
    "Circles",
    "Encoding",
    "ForwardModel",
    "Kinematics",
    "Planner",
    "SparseGaussianProcess",
]
